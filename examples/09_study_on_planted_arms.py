"""Compare losses on simulated arms with planted errors, measured with gross readings: in memory, against the truth.

python examples/09_study_on_planted_arms.py [FOLDER]
"""

import practice

import calib

practice.enter(__file__)

tracker = calib.SimulatedInstrument("tracker", 2e-5, None, outlier_share=0.05, outlier_size=10e-3)
settings = calib.FitSettings(model="geometry")
losses = {"loss": ["none", "huber", "cauchy"]}
for arm in calib.population("ur5", 3, seed=1, instrument=tracker):
    measured = arm.measure(arm.postures(40))

    def figures(fit: calib.GeometryFit, arm=arm) -> dict[str, object]:
        errors = arm.position_errors(fit, arm.postures(200, seed=9))  # against the truth, at other postures
        return {"largest error [mm]": 1e3 * errors.max()}

    table = calib.sweep(calib.fit_geometry, arm.nominal, measured, settings=settings, over=losses, figures=figures)
    print(arm, table, sep="\n")
