"""Applications: what commands offer beside the procedure, each a package that can be deleted."""
