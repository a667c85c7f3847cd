"""Searches over continuous joint values: local search, multistart, global search (MLSL), and tabu search."""
