"""Checks of measurements by the residuals of a rigid arm: changes of the set-up, invalid readings, wrong rows."""
