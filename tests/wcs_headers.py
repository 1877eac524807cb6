"""Cards of coordinate systems that several tests share."""

PLAIN = {
    "CTYPE1": "RA---TAN",
    "CTYPE2": "DEC--TAN",
    "CRPIX1": 6.0,
    "CRPIX2": 8.0,
    "CRVAL1": 150.0,
    "CRVAL2": 30.0,
}
# Pixels of 0.036 arcsec, north up.
NORTH_UP = PLAIN | {"CDELT1": -1e-5, "CDELT2": 1e-5}
LINEAR = {
    "CTYPE1": "RA---TAN",
    "CTYPE2": "DEC--TAN",
    "CRPIX1": 5.5,
    "CRPIX2": 4.25,
    "CRVAL1": 248.62114984968,
    "CRVAL2": 70.53098794332,
    "CD1_1": -1.1e-5,
    "CD1_2": 2.3e-6,
    "CD2_1": 2.2e-6,
    "CD2_2": 1.2e-5,
}
SIP_TERMS = {
    "CTYPE1": "RA---TAN-SIP",
    "CTYPE2": "DEC--TAN-SIP",
    "A_ORDER": 2,
    "A_2_0": 1e-3,
    "B_ORDER": 2,
    "B_0_2": -2e-3,
}
SIP = LINEAR | SIP_TERMS
TPV = LINEAR | {
    "CTYPE1": "RA---TPV",
    "CTYPE2": "DEC--TPV",
    "PV1_1": 1.0,
    "PV1_4": 40.0,
    "PV2_1": 1.0,
}
PHYSICAL = {f"{name}P": value for name, value in {"CTYPE1": "x", "CTYPE2": "y"}.items()} | {
    "CRPIX1P": 3.0,
    "CRPIX2P": -7.5,
    "CRVAL1P": 4032.5,
    "CRVAL2P": 3994.5,
    "CDELT1P": 0.25,
    "CDELT2P": 0.5,
}
