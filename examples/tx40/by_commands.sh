#!/bin/bash
# The TX40 study by commands: least squares, instrumental variables, constraints and the power model, after Janot's slides.
#     bash examples/tx40/by_commands.sh [FOLDER]
# practice.py stands for the robot: it plays the designed motion twice, and a random one to judge by; degraded.csv has
# 1 mrad of noise on its positions.
set -euo pipefail
examples=$(cd "$(dirname "$0")/.." && pwd)
mkdir -p "${1:-tx40-by-commands}" && cd "${1:-tx40-by-commands}"

filter=$'[filter]\ncutoff = 60.0\nband = 20.0\n'                                  # too wide for 1 mrad of noise
printf '%s' "$filter" > wide.toml
printf '%s[constraints]\nsigns = true\n' "$filter" > signs.toml
printf 'rows = "power"\n' > power.toml
cat > loop.toml <<EOF
$filter
[loop]                        # gains of the controller, at the joint: N m/rad, N m s/rad
controller = "pd"
kp = [2920, 3034, 472, 104, 103, 30]
kd = [93, 97, 15, 3.3, 3.3, 0.95]
velocity_cutoff = 60
feedforward = "cad"
EOF

calib excite tx40 --period 10 --goal normalised=6 --starts 1 --no-outlook --no-plots --out motion
python "$examples/practice.py" log run.csv tx40 motion
python "$examples/practice.py" log other.csv tx40 2
python "$examples/practice.py" degrade run.csv degraded.csv 1

identify() { calib identify tx40 "$1" --validate other.csv --friction standard --no-plots "${@:2}"; }
identify run.csv --out ls                                                         # clean: least squares
identify degraded.csv --out filtered                                              # degraded: filters by the data
identify degraded.csv --options wide.toml --out degraded_ls                       # filters too wide: biased
identify degraded.csv --options signs.toml --method pc-wls --out degraded_pc      # constraints do not cure that
identify degraded.csv --options loop.toml --method iv --excitation motion --out degraded_iv
identify run.csv --options power.toml --out power                                 # one row per sample: power
