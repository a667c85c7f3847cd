"""Certificate (HTML, PDF) of at most four pages, and report with all tables and figures, of sessions and results."""

OFFERS = {
    "commands": "commands:app",
    "steps": "session:STEP",
    "fit_pages": "results:write_fit",
    "model_pages": "results:write_model",
    "notebook": "results:notebook",
}
