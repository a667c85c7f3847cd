"""Joint corrections of the geometric fit in dynamics: links move as compliance, gears and encoders make them.

Motors turn drives, links carry masses: base parameters' columns are computed at the links' motion, drives' columns at
the motors'. Identified masses go back into the fit's gravity torques.
"""

OFFERS = {
    "link_motion": "link_motion:with_link_motion",
    "deflection_sensitivity": "link_motion:deflection_sensitivity",
    "identified_masses": "masses:identified_masses",
    "return_masses": "masses:return_masses",
}
