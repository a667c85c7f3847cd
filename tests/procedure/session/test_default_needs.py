"""The end of a session that states no need names what is above 10 %, and what to write for a further motion."""

from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import numpy as np

from calib.identification.prediction import PredictionErrors, RelativeErrors, Score
from calib.procedure.session.second_round import promised

HEADER = "name,unit,value,sigma,rsd,essential\n"


def session(folder: Path, errors: list[float], rows: str, **section: Any) -> Any:
    """Return what the end reads of a complete session: joints' errors on unseen motion [%], rows of the estimate."""
    (folder / "estimate.csv").write_text(HEADER + rows)
    joints = np.array(errors)
    part = PredictionErrors(RelativeErrors(max(errors), joints), np.ones(len(errors)), 100)
    score = Score(part, part, part, part, 0.0 * joints, 0.0 * joints, (None,) * len(errors), 20.0, 1.0)
    report = Made(proofs={"unseen": score}, fit={})
    stated = {"plan": True, "tolerance_percent": 0.0, "sigma_percent": 0.0, "payloads": {}} | section
    columns = [Made(name="Fs2", form=Made(slopes=False)), Made(name="Fv1", form=Made(slopes=True))]
    return Made(
        dynamic=True, needs=bool(stated["tolerance_percent"] or stated["sigma_percent"]), folder=folder,
        settings=Made(dynamics=Made(**stated)), fit=Made(path="tx40"),
        identification=Made(
            path=folder, unseen=Made(read=lambda: report),
            dynamics=lambda: Made(model=Made(n=len(errors), columns=columns)),
        ),
    )  # fmt: skip


FINE = "ZZ1R,kg m²,1.0,0.05,5.0,0.04\n"
WEAK = "MX2,kg m,1.0,0.4,40.0,0.3\nFv1,N m s/rad,1.0,0.15,15.0,0.1\n"


def test_worst_above_ten_percent_come_first(tmp_path: Path) -> None:
    """Joints and parameters above ten percent are named, the worst first."""
    unseen = "off3,N m,1.0,9.0,900.0,\nFs2,N m,1.0,0.5,50.0,0.4\n"  # not essential; no motion can be designed for it
    (line,) = promised(session(tmp_path, [3.0, 25.0, 4.0, 3.0, 3.0, 12.0], FINE + WEAK + unseen))
    assert line.startswith(
        "above 10 %: torque of joint_2 (25 %); torque of joint_6 (12 %); σ of essential parameters MX2"
    )
    assert "MX2 (40 %), Fv1 (15 %);" in line and not any(name in line for name in ("ZZ1R", "off3", "Fs2"))
    assert "write sigma_percent = 10 and tolerance_percent = 10 under [dynamics] in session.toml" in line
    assert line.endswith(f"calib next {tmp_path}")


def test_lone_shortfall_names_one_key(tmp_path: Path) -> None:
    """One key is named where only one kind falls short."""
    (line,) = promised(session(tmp_path, [3.0] * 6, WEAK))
    assert "sigma_percent = 10 under" in line and "tolerance" not in line and "torque of" not in line


def test_what_is_good_enough_is_said(tmp_path: Path) -> None:
    (line,) = promised(session(tmp_path, [3.0] * 6, FINE))
    assert line.startswith("no further motion is needed") and "within 10 %" in line
