"""Commands on parallel robots: the same verbs as for serial arms, on closed loops."""
