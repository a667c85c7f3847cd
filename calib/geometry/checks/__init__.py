"""Checks of measurements by the residuals of a rigid arm: changes while measuring, invalid readings, wrong rows."""
