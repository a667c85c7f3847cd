"""Update of identified dynamics by the logs of production: `calib update`."""
