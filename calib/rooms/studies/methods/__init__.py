"""The survey's methods, for comparisons only."""

from calib.rooms.studies.methods.bounded_errors import GTLS, SET_MEMBERSHIP
from calib.rooms.studies.methods.filters import CDKF, EKF, SRCDKF, SREKF, SRUKF, UKF
from calib.rooms.studies.methods.maximum_likelihood import ML
from calib.rooms.studies.methods.networks import ADALINE, HOPFIELD
from calib.rooms.studies.methods.output_error import CLIE, CLOE

METHODS = (ML, CLOE, CLIE, EKF, SREKF, UKF, SRUKF, CDKF, SRCDKF, ADALINE, HOPFIELD, GTLS, SET_MEMBERSHIP)
