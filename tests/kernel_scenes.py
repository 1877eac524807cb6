"""The scenes that kernels are tested with."""

import kernel_harness as harness

FOUR_TIMES_AS_FINE = "sky four times as fine, exposure map, mu"
THREE_FINE_SKIES = "three skies twice as fine, two images, map of smoothing"
TWO_TURNED_SKIES = "two skies, three images turned, two stars, mask, background map"
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
    THREE_FINE_SKIES: {
        "n_images": 2,
        "n_skies": 3,
        "has_weights": True,
        "has_smoothing": True,
        "has_smoothing_map": True,
        "oversample": 2,
    },
    TWO_TURNED_SKIES: harness.SCENES[harness.TURNED] | {"n_skies": 2},
}
