#!/bin/sh
# Make four PSFs of a Fizeau interferometer, at four angles of its baseline, from one real frame:
# Altair at 4.05 um, taken with LMIRcam of the Large Binocular Telescope Interferometer.
#
#     sh examples/real/altair_psfs.sh [DATA]
#
# writes altair_psfs.fits and altair_psfs.png to the current folder. DATA is the folder that
# lbti-fizeau-altair/ is in.
set -eu

data=${1:-$(dirname "$0")/../../../shared/data}
frame=$data/lbti-fizeau-altair/lm_180507_009030.fits
if [ ! -e "$frame" ]; then
    echo "skipped: $frame is not there"
    exit 0
fi

# The frame is background-subtracted; the fringe peaks in its core are clipped at 57 to 59 kADU;
# beyond 144 pixels the corners of the rotated crops would reach the padding at its bottom.
lnocl psf "$frame" --background 0 --saturation 57000 --size 144 --rotate 0 45 90 135 \
    --clip-negative -o altair_psfs.fits --plot altair_psfs.png --overwrite
