"""Studies: how identification methods compare over robots, noise, rates and wrong beliefs, by Monte Carlo.

A condition (`conditions`) is an experiment whose truth is known (`experiment`); one pure function makes a row of a
condition, a method and a seed (`trial`); rows are keyed and kept (`rows`), run wherever workers are (`run`), and summed
up so that methods can be ranked (`summary`).
"""

OFFERS = {"commands": "commands:app", "topics": ":TOPICS", "schemas": ":SCHEMAS", "methods": "methods.listing:METHODS"}
TOPICS = {"study": ("the TOML file of calib study", ("calib.rooms.studies.conditions",))}
SCHEMAS = {"study": ("calib.rooms.studies.conditions", "StudyFile")}
