"""What a verdict says of single joints, of motion beyond the limits, of parameters that motion does not tell."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.data.signals.persistency import report_excitation
from calib.identification.identify import identify
from calib.identification.prediction import PredictionErrors, RelativeErrors, Score
from calib.identification.settings import IdentificationSettings
from calib.procedure.dynamic_stage import verdict
from calib.procedure.dynamic_stage.verdict import Resting, judge, with_prior
from calib.procedure.findings import Verdict

TORQUE = np.array([10.0, 100.0, 0.5])  # rms of each joint: the third does not matter


def scored(joints, moving=None, total=5.0, share=1.0) -> Score:
    """Return a score of which `joints` [%] are unexplained in the band."""
    joints = np.asarray(joints, dtype=float)
    part = PredictionErrors(RelativeErrors(total, joints), joints * TORQUE / 100.0, 300)
    moved = (
        part
        if moving is None
        else replace(part, relative_error_percent=RelativeErrors(total, np.asarray(moving, dtype=float)))
    )
    return Score(part, part, moved, part, 0.0 * joints, 1.0 - joints / 100.0, (None,) * 3, 20.0, share)


def judged(unseen: Score | None, own: Score | None = None) -> Verdict:
    motion = planted.case("train", 0).motion
    validation = {} if unseen is None else {"other": unseen}
    return Verdict.of(*judge({"train": own or scored([4, 4, 4])}, validation, {}, {"train": report_excitation(motion)}))


@pytest.mark.parametrize(
    "joints, moving, level, named",
    [
        ([5, 5, 49], None, "pass", ""),
        ([5, 5, 51], None, "marginal", "joint 3 (51 %"),
        ([5, 5, 102], None, "marginal", "joint 3 (102 %"),
        ([94, 5, 5], None, "marginal", "joint 1 (94 %"),
        ([96, 5, 60], None, "fail", "joint 1 (96 %), joint 3 (60 %"),
        ([96, 5, 5], [20, 5, 5], "pass", ""),  # wrong at rest only
        ([96, 5, 5], [np.nan, 5, 5], "pass", ""),  # never moves
    ],
)
def test_joint_without_model_is_named(joints, moving, level, named):
    """A joint without a model is named, and fails where its torque matters."""
    found = judged(scored(joints, moving))
    assert found.level == level
    assert named in found.reason and found.code == ("joints-unexplained" if named else "")


def test_total_says_which_criterion_failed():
    """The total says which criterion was missed."""
    found = judged(scored([11, 11, 11], total=11.0))
    assert (found.level, found.code) == ("marginal", "torque-unexplained")
    found = judged(scored([9, 9, 9], total=9.0), scored([4, 4, 4], total=4.0))
    assert (found.level, found.code) == ("marginal", "no-torque-transfer")
    found = judged(scored([31, 31, 31], total=31.0))
    assert (found.level, found.code) == ("fail", "torque-unexplained")


def test_fit_joints_count_without_unseen():
    """Without unseen motion the joints of the fit count."""
    _, found = judge({"train": scored([4, 70, 4])}, {}, {}, {})
    assert [one.code for one in found] == ["no-unseen-motion", "joints-unexplained"]
    assert found[1].values["joints"] == ("joint 2 (70 %)",)


@pytest.mark.parametrize("own, unseen, level", [(29, None, "marginal"), (31, None, "fail"), (31, 20, "fail")])
def test_model_missing_its_own_motion_fails(own, unseen, level):
    """A model that misses its own motion fails without unseen motion, too."""
    other = None if unseen is None else scored([4, 4, 4], total=unseen)
    found = judged(other, scored([4, 4, 4], total=own))
    assert found.level == level and (found.code == "training-torque-unexplained") == (level == "fail")


def test_motion_far_beyond_limits_is_warned():
    """Motion far beyond the limits is a warning."""
    case, chain = planted.case("train", 0), planted.arm()
    assert verdict.beyond(case, chain) == []
    reach = float(np.abs(case.motion.q[:, 1]).max())
    tight = tuple(replace(one, lower=-0.8 * reach, upper=0.8 * reach) if j == 1 else one
                  for j, one in enumerate(chain.joints))  # fmt: skip
    (finding,) = verdict.beyond(case, replace(chain, joints=tight))
    assert finding.code == "beyond-joint-limits"
    assert [words.split(" by ")[0] for words in finding.values["joints"]] == ["joint2"]


@pytest.mark.parametrize("count", [5, 6])
def test_reason_says_that_most_are_from_cad(count):
    """That most parameters are from the CAD stands in the reason."""
    rests = Resting(tuple(f"p{k}" for k in range(count)), 10, "cad")
    reason = with_prior(Verdict("marginal", "why"), rests).reason
    assert reason == "why" if count == 5 else "6 of 10 parameters" in reason


def test_negative_drives_are_told_with_sigma() -> None:
    """Without the prior nothing keeps friction above zero; the log is made to push joint 2 along."""
    own = planted.case("train", 0)
    robot, settings = planted.arm(), IdentificationSettings(friction="standard", prior="none")
    target = own.target.copy()
    target[:, 1] -= 6.0 * own.motion.v[:, 1]
    found = identify(robot, [replace(own, target=target)], settings)
    (told,) = [one.values["names"] for one in verdict.model_findings([own], found) if one.code == "negative-drives"]
    assert [name.split(" = -")[0] for name in told] == ["Fv2"]
    sound = identify(robot, [own], settings)
    assert "negative-drives" not in {one.code for one in verdict.model_findings([own], sound)}
