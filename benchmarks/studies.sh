#!/usr/bin/env bash
# What the paper left open, as tables and pictures: docs/validation/studies.md. Usage: studies.sh FOLDER
# Each command goes on where its table ends.
set -euo pipefail
folder=$1
study() { # NAME AXIS...
  local name=$1
  shift
  python "$(dirname "$0")/study.py" -o "$folder/study-$name.ecsv" --plot "$folder/study-$name.png" \
    "$@"
}
study contrast --size 512 --contrast 0.0001 0.001 0.01 0.1 1 10 100 1000 10000 --method mc-rl rl --seed 0 1 2 3
study position --position-error 0 0.001 0.003 0.01 0.03 0.1 0.3 1 --refine no yes --contrast 1 10 100 --seed 0 1 2
study psf --psf-error 0 0.01 0.03 0.1 0.2 --contrast 0.1 1 10 100 --seed 0 1 2
study images --n-images 1 2 3 4 6 8 --contrast 1 10 --seed 0 1 2 3
study solver --solver sgp sgm --contrast 1 10 100 --seed 0 1
