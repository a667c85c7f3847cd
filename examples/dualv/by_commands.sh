#!/bin/bash
# The DualV study by commands: Briot, Gautier and Krut (2013), geometry before it.
#     bash examples/dualv/by_commands.sh [FOLDER]
# practice.py stands for the robot: encoders with platform poses, logs without and with a plate of 5.37 kg, another one.
set -euo pipefail
examples=$(cd "$(dirname "$0")/.." && pwd)
mkdir -p "${1:-dualv-by-commands}" && cd "${1:-dualv-by-commands}"

cat > plate.toml <<'EOF'
[payload.plate]
[files."load.csv"]
payload = ["plate"]
[files."other.csv"]
payload = ["plate"]
EOF
(echo 'rows = "power"'; cat plate.toml) > power.toml
(echo 'identical_legs = true'; cat power.toml) > equal_legs.toml

python "$examples/practice.py" platform .
calib fit dualv measured.csv --holdout 0.25 --no-plots --out fit                  # geometry of the loops
for model in plate power equal_legs; do                                           # IDIM, PIM, PIM with equal legs
    calib identify fit empty.csv load.csv --options $model.toml --validate other.csv --no-plots --out $model
    grep ^Mplate $model/estimate.csv | cut -d, -f1,3-5
done
calib export plate --into calibrated
