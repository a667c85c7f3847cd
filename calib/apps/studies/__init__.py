"""Monte Carlo studies that compare identification methods over robots, noise, sampling rates and model errors.

Each condition (`conditions`) defines a simulated experiment with known true parameters (`experiment`). A trial applies
one method to one simulated data set and yields a row of figures of merit (`trial`). Rows are stored by key (`store`),
computed by workers (`run`), and summarised to rank the methods (`summary`).
"""

OFFERS = {"commands": "commands:app", "formats": ":FORMATS"}
FORMATS = {"study": ("the TOML file of calib study", "calib.apps.studies.conditions", "StudyFile")}
