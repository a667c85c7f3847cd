"""Further methods of the survey by Leboutet et al. (2021), for comparisons only."""

from calib.identification.survey.bounded_errors import GTLS, SET_MEMBERSHIP
from calib.identification.survey.filters import CDKF, EKF, SRCDKF, SREKF, SRUKF, UKF
from calib.identification.survey.maximum_likelihood import ML
from calib.identification.survey.networks import ADALINE, HOPFIELD
from calib.identification.survey.output_error import CLIE, CLOE

METHODS = (ML, CLOE, CLIE, EKF, SREKF, UKF, SRUKF, CDKF, SRCDKF, ADALINE, HOPFIELD, GTLS, SET_MEMBERSHIP)
