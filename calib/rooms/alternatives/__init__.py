"""Alternatives to weighted least squares: robust, total, and under constraints on parameters (pc-*).

Settings of the constraints and what they report are records of the core: `calib.identification.constraint_settings`.
"""

OFFERS = {"methods": "estimators:METHODS"}
