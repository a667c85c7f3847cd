"""How sure an identified model is, the geometry's share included."""
