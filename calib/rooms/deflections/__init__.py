"""Joint corrections of the geometric fit in dynamics: links move as compliance, gears and encoders make them.

Motors turn drives, links carry masses: base parameters' columns are computed at the links' motion, drives' columns at
the motors'.
"""

OFFERS = {"link_motion": "link_motion:with_link_motion", "deflection_sensitivity": "link_motion:deflection_sensitivity"}
