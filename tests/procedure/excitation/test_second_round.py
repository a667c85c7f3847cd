"""A motion designed after an identification: what it is predicted to add, and what it adds."""

from dataclasses import replace

import numpy as np
import pytest

import calib
from calib.procedure.excitation.prediction import ADDED_ERRORS
from calib.simulation.virtual_arm import moving_arm, play, record
from calib.simulation.virtual_cells import lwr4plus_cell

FIRST = calib.ExcitationSettings(period=6.0, harmonics=4, starts=1, evaluations=60, outlook=False)
LIMITS = {
    "friction": {
        "Fv": [14.4, 15.3, 6.55, 11.0, 4.29, 2.26, 1.6], "Fc": [11.9, 11.5, 8.98, 8.35, 8.31, 4.72, 6.04],
    },
}  # fmt: skip


def _sigma(model):
    return dict(zip(model.found.names, model.found.fitted.estimate.sigma))


@pytest.mark.slow
def test_the_predicted_sigma_is_reached(tmp_path):
    """Of the parameters that both know, half are within 30 % of the prediction and the median within 20 %."""
    arm = moving_arm(lwr4plus_cell(), "lwr4plus", 0)

    def log(design, seed):
        return record(arm, play(*design.sampled(), 1), np.random.default_rng(seed))

    first = calib.design_excitation("lwr4plus", FIRST, limits=LIMITS)
    logs = [log(first, 1)]
    known = calib.identify_dynamics("lwr4plus", logs)
    known.save(tmp_path / "known", plots=False)
    more = replace(FIRST, period=10.0, harmonics=6, evaluations=120)
    design = calib.design_excitation("lwr4plus", more, after=tmp_path / "known")
    assert "most improved" in str(design) and "so far" in str(design)
    reached = _sigma(calib.identify_dynamics("lwr4plus", [*logs, log(design, 2)]))
    before = _sigma(known)
    predicted = {row.name: row for row in design.predicted}
    # a further recording informs, but adds errors, too, which widen what it does not inform on
    widening = np.sqrt(ADDED_ERRORS)
    assert all(row.sigma <= widening * row.sigma_before for row in predicted.values())
    both = [name for name in predicted if reached.get(name, 0.0) > 0.0]
    assert np.allclose([predicted[name].sigma_before for name in both], [before[name] for name in both], rtol=1e-3)
    ratio = np.array([reached[name] / predicted[name].sigma for name in both])
    assert 0.8 < np.median(ratio) < 1.2
    assert (np.abs(ratio - 1.0) < 0.3).mean() > 0.5
    assert np.median([reached[name] / before[name] for name in both]) < 0.8
