"""Certificate (HTML, PDF) of at most four pages, and report with all tables and figures, of sessions and results."""
