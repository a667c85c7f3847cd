"""Recordings that are stated as unseen, and belong to the training data."""

from types import SimpleNamespace
from typing import cast

import numpy as np

from calib.identification.rows import Case
from calib.procedure.dynamic_stage.identify import overlaps


def _piece(name: str, first: float, last: float) -> Case:
    motion = SimpleNamespace(file="log.csv", t=np.array([first, last]))
    return cast(Case, SimpleNamespace(name=name, motion=motion))


def test_pieces_of_one_file_that_overlap_are_named():
    training = _piece("log.csv@0:9", 0.0, 9.0)
    (remark,) = overlaps([training], [_piece("log.csv@8:12", 8.0, 12.0)])
    assert remark.code == "unseen-overlaps"
    assert (remark.values["first"], remark.values["last"]) == (8.0, 9.0)
    assert overlaps([training], [_piece("log.csv@9:12", 9.0, 12.0)]) == []
