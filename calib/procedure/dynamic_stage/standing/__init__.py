"""Gravity from torques at rest: ``calib identify ROBOT poses.csv --out gravity``.

A file with one row per standing pose (joints and torques, no stamps), or a log that stands at its poses, shows gravity
and nothing else of the dynamics. What standing poses determine are the base parameters of the gravity regressor (first
moments and masses), and a payload's mass and centre where one file is with it and one without::

    [payload.tool]
    [files."loaded.csv"]
    payload = ["tool"]

Friction holds a standing joint within ±Fs of its gravity torque. Without columns ``approach1`` … ``approachn`` (+1
where the joint moved upwards before it stood, -1 downwards, 0 unknown) only a band is known, which contains 95 % of the
residuals; with them, Fs is estimated. Inertias and friction in motion are not identified: those of the description
stay.

The model is judged on the poses of ``--validate``, or on a quarter of the poses that it is not fitted to.

Source: W. Khalil and E. Dombre (2002), Modeling, Identification and Control of Robots, sections 9.4 and 12.3.
"""
