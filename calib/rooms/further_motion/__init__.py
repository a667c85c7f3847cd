"""Motions after an identification: the step `extend` of a session, and the geometry's part in predicted sigmas."""

OFFERS = {
    "steps": "second_round:STEP",
    "endings": "second_round:promised",
    "geometry_spread": "geometry_spread:geometry_spread",
}
