"""Robot controllers: what each shows, and what it can be told."""
