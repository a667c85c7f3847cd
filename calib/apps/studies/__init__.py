"""Monte Carlo studies that compare identification methods over robots, noise, sampling rates and model errors.

A condition (`conditions`) is an experiment whose truth is known (`experiment`); one pure function makes a row of a
condition, a method and a seed (`trial`); rows are keyed and kept (`rows`), run wherever workers are (`run`), and summed
up so that methods can be ranked (`summary`).
"""

OFFERS = {"commands": "commands:app", "formats": ":FORMATS"}
FORMATS = {"study": ("the TOML file of calib study", "calib.apps.studies.conditions", "StudyFile")}
