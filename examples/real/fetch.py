"""Fetch the public data that the scripts beside this one need.

    python examples/real/fetch.py [FOLDER] [--only SET ...] [--list]

The packages pooch and h5py do it: ``pip install pooch h5py``. Each file comes from the public
repository named below, at one commit, and its SHA-256 is compared. A file that is there already,
with this checksum, is not fetched again. The frames of the lensed quasar are published as HDF5
and are converted to FITS, without change of values.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from astropy.io import fits

HOST = "https://raw.githubusercontent.com"

# A line without indent: folder to fetch to, repository, commit. Then each file of it in two lines:
# bytes, path in the repository and, where it differs, the name here; SHA-256.
FILES = """
chandra-pg1634-point sherpa/sherpa-test-data 1b026cbaceb8c86f13952b0df2194537d8b07992
  86400 sherpatest/center_box_0.25pix.fits pg1634_counts_0.25pix.fits
    8f3f5ebe40f7c9c07d0ef73a34882919bb809b70681ca679735f79c3379c7ea7
  535680 sherpatest/psf_f1_norm_0.25pix.fits pg1634_psf_0.25pix.fits
    1281755b1b1509ece9754fba011eebba3b16cbaac62d391e877873b256fb339c
chandra-sgra-pair astrostat/pylira 9348762a079fe040a7adcbdf0cab40ef04be14d1
  24867 pylira/data/files/chandra-counts-obs-id-4683.fits.gz
    6cd6214ba9ac65f18480a4b004a06446a4d29472d1b1ec0b3a27a44363c5e81f
  24717 pylira/data/files/chandra-counts-obs-id-4684.fits.gz
    80af9c588004423c4fd0c5aee9cefcb21f0ea5f650e5237589dbdd37eb743672
  7540 pylira/data/files/chandra-psf-obs-id-4683.fits.gz
    098ce23a4ba8e21a04cfac5c2f93987648b995735db9d6ed461559d6d7be9269
  7525 pylira/data/files/chandra-psf-obs-id-4684.fits.gz
    ff479843a47303a0f784456d1794cba301e64172f953f5bf75536a24a96dee9f
hst-hsc-cosmos pmelchior/scarlet 998ca34cf7441bc372280302178de2568990babb
  103680 data/test_resampling/Cut_HSC.fits
    d54772cd0d3e79e794269e2cec7a6f5659d9295fc199328a125ebbc8b591fb2b
  103680 data/test_resampling/Cut_HSC1.fits
    110fcd8594402988cf5e2856d13eb99186fcb2f85dc94bb914d2446ec2e31790
  253440 data/test_resampling/Cut_HST.fits
    7d9cee2c99175489104567d4a52b8423b56ece3235ff8d9257008e502dfacbba
  253440 data/test_resampling/Cut_HST1.fits
    cbbee12490705aa54d80317a688e5d02f903fad6482ccbfba0f74274fc4514e7
  43200 data/test_resampling/PSF_HSC.fits
    de1206236ff9628829d26aa43eddf9aab49c0b3ff83eb689340d7aab43e1f454
  262080 data/test_resampling/PSF_HST.fits
    8d3a000d6871c74b4124389738a2f70345fa7e4d4bd7099d73b0b6e4aa86b379
hst-lensed-quasar ajshajib/dolphin 4c2cbf2d7dbdc2afa2b9a8c95c290b38dc4d0822
  119352 io_directory_example/data/lensed_quasar/image_lensed_quasar_F814W.h5
    73ecf4ff0216a1c5b20578ccad7cc3aeaa794113f12af2e1fcc1a09981fcea5c
  46700 io_directory_example/data/lensed_quasar/psf_lensed_quasar_F814W.h5
    3175b01c33797d1f095563b791fa8a7eea782dc4aa05efb694012ac541a09292
hst-quasar-j0005 mmechtley/psfMC 77b7b8a28760364ae2ea4dc88ac71ca703b54766
  132480 examples/sci_J0005-0006.fits
    4bbfdcc6ce2a45f549863dee13075ac754a7474d7c691fdeff09fa56d25a422a
  132480 examples/ivm_J0005-0006.fits
    aa09c7ace3a3f5f44c9d198e174f138b1849853172ef9306f628a4522cf46e6a
  83520 examples/sci_psf.fits
    7bb62b11a61ed24379455c9596765d80e6c1bb6de8f870b30f99cb2c08ce0681
lbti-fizeau-altair mwanakijiji/lbti_altair_fizeau f213cf37770e8fa70e74cd28aac61cf9f3f1d3dc
  673920 lm_180507_009030.fits
    bfe6777571be917a185a1b3a6f01b0c726bfb8a2d68a92af1634cff5fe1c0132
naco-betapic carlgogo/VIP_extras a7ec7ac9aeabcb5df73b9ea57270c6d66f9e3f57
  2494080 datasets/naco_betapic_cube.fits
    5d7f7db98522128704c1e3a6ce3bc47e35ec469c44570d2f86533b242e9a5a79
  5760 datasets/naco_betapic_pa.fits
    1ebe4212da8dd0d02b19eefbcd473498c5c1ebc5ad348161ed2a9ade1eb8a519
  11520 datasets/naco_betapic_psf.fits
    ca4e0ad99c4119f3ad4e9b33fad9b157746343d8b54f4668681dfa1a398315be
not-nebula-ou5 will-henney/teresa-pn-ou5 97550c855dbf714125c088fbc699a5a1f358e47e
  1287360 data/nordic-images/nordic-ou5-ha-00-regrid.fits
    b0c487e331cf1d166e8182d6e709cf86c5cc961b6fdd1eee0b21c1ad971d0837
  1287360 data/nordic-images/nordic-ou5-ha-01-regrid.fits
    b19d931161f9db0c5c9537158990591f7ac94b4c77a3a8bac0f029a14cd38009
  1287360 data/nordic-images/nordic-ou5-cont-00-regrid.fits
    f9be4560fe961fb9a190571a6d35cd0bd8535af6dbe07f323cf990368f62decd
  1287360 data/nordic-images/nordic-ou5-cont-01-regrid.fits
    a2dbec425a9e57fb004666a12c05c3fb29eb39642c2dbf24cde58dbcb07d6189
spitzer-glimpse astropy/photutils-datasets 8c97b4fa3a6c9e6ea072faeed2d49a20585658ba
  2113920 data/spitzer_example_image.fits spitzer_glimpse_irac2_l18.fits
    4b9cf15419de311fc683a9c378327a0b28bfee29d01e4fdbb9dc5780417f7ebc
"""


def files() -> list[tuple[str, str, int, str, str]]:
    """Return folder, name, bytes, SHA-256 and address of each file."""
    found = []
    lines = iter(FILES.strip().splitlines())
    for line in lines:
        if not line.startswith(" "):
            folder, repository, commit = line.split()
            continue
        size, path, *name = line.split()
        name = name[0] if name else Path(path).name
        address = f"{HOST}/{repository}/{commit}/{path}"
        found.append((folder, name, int(size), next(lines).strip(), address))
    return found


def convert(folder: Path) -> None:
    """Write the frames of the lensed quasar as FITS files beside their HDF5 files."""
    import h5py

    with h5py.File(folder / "image_lensed_quasar_F814W.h5") as image:
        known = {"BUNIT": "ELECTRONS/S", "FILTER": "F814W", "TELESCOP": "HST", "PIXSCALE": 0.04}
        known["BKGRMS"] = float(image["background_rms"][()])
        frames = {"sci": (image["image_data"][()], known)}
        frames["exptime"] = (image["exposure_time"][()], {"BUNIT": "S"})
    with h5py.File(folder / "psf_lensed_quasar_F814W.h5") as psf:
        frames["psf"] = (psf["kernel_point_source"][()], {"PIXSCALE": 0.04})
    for name, (data, cards) in frames.items():
        path = folder / f"quasar_F814W_{name}.fits"
        fits.writeto(path, data.astype(np.float32), fits.Header(cards), overwrite=True)


def main() -> None:
    """Fetch the files, or list them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    here = Path(__file__).parent / "data"
    parser.add_argument("folder", type=Path, nargs="?", default=here, help="by default data/ here")
    sets = sorted({folder for folder, *_ in files()})
    some = ", ".join(sets)
    parser.add_argument("--only", nargs="+", choices=sets, default=sets, metavar="SET", help=some)
    parser.add_argument("--list", action="store_true", help="print name, bytes and address")
    options = parser.parse_args()
    try:
        for folder, name, size, sha256, address in files():
            if folder not in options.only:
                continue
            if options.list:
                print(f"{folder}/{name}", size, address)
                continue
            import pooch

            pooch.retrieve(address, f"sha256:{sha256}", name, options.folder / folder)
        if "hst-lensed-quasar" in options.only and not options.list:
            convert(options.folder / "hst-lensed-quasar")
    except ImportError as error:
        sys.exit(f"fetch.py: {error}; do: pip install pooch h5py")
    except (OSError, ValueError) as error:
        sys.exit(f"fetch.py: {error}")


if __name__ == "__main__":
    main()
