"""The scenes that kernels are tested with."""

import kernel_harness as harness

FOUR_TIMES_AS_FINE = "sky four times as fine, exposure map, mu"
SCENES = harness.SCENES | {
    "two images, star, mu": {"n_images": 2, "n_stars": 1, "has_mu": True},
    "mask, mu, smoothing": {
        "n_images": 1,
        "has_weights": True,
        "has_mu": True,
        "has_smoothing": True,
    },
    FOUR_TIMES_AS_FINE: {
        "n_images": 2,
        "n_stars": 1,
        "has_mu": True,
        "has_weights": True,
        "has_exposure_map": True,
        "has_background_map": True,
        "oversample": 4,
    },
}
