#!/bin/bash
# The TX40 study by commands: least squares, instrumental variables, constraints and the power model, after Janot's slides.
#     bash examples/tx40/by_commands.sh [FOLDER]
# practice.py stands for the robot: it plays the designed motion twice, and a random one to judge by; degraded.csv has
# 1 mrad of noise on its positions.
set -euo pipefail
examples=$(cd "$(dirname "$0")/.." && pwd)
mkdir -p "${1:-tx40-by-commands}" && cd "${1:-tx40-by-commands}"

cat > loop.toml <<'EOF'
[loop]                        # gains of the controller, at the joint: N m/rad, N m s/rad
controller = "pd"
kp = [2920, 3034, 472, 104, 103, 30]
kd = [93, 97, 15, 3.3, 3.3, 0.95]
velocity_cutoff = 60
feedforward = "cad"
EOF
printf '[constraints]\nsigns = true\n' > signs.toml
printf 'rows = "power"\n' > power.toml

calib excite tx40 --period 10 --goal normalised=6 --starts 1 --no-outlook --no-plots --out motion
python "$examples/practice.py" log run.csv tx40 motion
python "$examples/practice.py" log other.csv tx40 2
python "$examples/practice.py" degrade run.csv degraded.csv 1

identify() { calib identify tx40 "$1" --validate other.csv --friction standard --no-plots "${@:2}"; }
identify run.csv --out ls                                                         # clean: least squares
identify degraded.csv --out degraded_ls                                           # degraded: biased
identify degraded.csv --method iv --options loop.toml --excitation motion --out degraded_iv
identify degraded.csv --method pc-wls --options signs.toml --out degraded_pc      # constraints do not cure the bias
identify run.csv --options power.toml --out power
