#!/bin/bash
# The LWR4+ study by commands, from poses to a plan on the identified model: Kolyubin, Shiriaev and Jubien (2019).
#     bash examples/lwr4plus/by_commands.sh [FOLDER]
# docs/tutorials/lwr_logs.md explains each line. practice.py stands for CMM and robot.
set -euo pipefail
examples=$(cd "$(dirname "$0")/.." && pwd)
mkdir -p "${1:-lwr4plus-by-commands}" && cd "${1:-lwr4plus-by-commands}" && ln -sfn "$examples" examples

cp examples/lwr4plus/{fixture,table_1,two_loads,motion_limits,loop}.toml examples/lwr4plus/{waypoints.csv,table_4.txt} .
calib select fixture.toml -m 17 --candidates 500 --index cond --constraints table_1.toml --no-plots --out poses.csv
calib select fixture.toml -m 20 --candidates 60 --seed 1 --constraints table_1.toml --no-plots --out other_poses.csv
python examples/practice.py cmm poses.csv measured.csv
python examples/practice.py cmm other_poses.csv other_measured.csv
calib fit lwr4plus measured.csv --validate other_measured.csv --no-plots --out fit
calib excite fit --options two_loads.toml --limits motion_limits.toml --load none --load 8 --rate 250 --period 25 --harmonics 5 --starts 1 --samples 120 --goal raw=35 --goal joint6=0.1 --goal joint7=0.1 $(printf -- '--column=%s ' $(cat table_4.txt)) --no-outlook --no-plots --out B
calib excite fit --options two_loads.toml --limits motion_limits.toml --within B --rate 250 --period 15 --harmonics 5 --starts 1 --evaluations 150 --seed 1 --no-outlook --no-plots --out other
python examples/practice.py log B.csv lwr4plus B both
python examples/practice.py log B_loaded.csv lwr4plus B both load
python examples/practice.py log other.csv lwr4plus other both
python examples/practice.py log other_loaded.csv lwr4plus other both load
sed 's/^rows = .*/rows = "link"/' two_loads.toml > link.toml
sed 's/^rows = .*/rows = "drive"/' two_loads.toml > drive.toml
calib identify fit B.csv B_loaded.csv --options link.toml --validate other.csv --validate other_loaded.csv --no-plots --out link
calib identify fit B.csv B_loaded.csv --options drive.toml --validate other.csv --validate other_loaded.csv --no-plots --out drive
calib identify fit B.csv B_loaded.csv --options two_loads.toml --validate other.csv --validate other_loaded.csv --no-plots --out both
grep ^M8, both/estimate.csv | cut -d, -f1,3-5
cat two_loads.toml loop.toml > iv.toml
calib identify fit B.csv@0:27 B_loaded.csv@0:27 --options iv.toml --method iv --excitation B --validate other.csv --validate other_loaded.csv --no-plots --out iv
calib plan fit --model both --waypoints waypoints.csv --no-plots --out plan
calib export both --into calibrated
printf 'rows = "both"\nfriction = "standard"\n' > short.toml
(cat short.toml; echo 'prior = "none"') > plain.toml
calib identify fit other.csv@2:5 --options short.toml --validate B.csv --no-plots --out short
calib identify fit other.csv@2:5 --options plain.toml --validate B.csv --no-plots --out plain || true
