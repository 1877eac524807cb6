"""The shears of images that are turned, against their twins."""

from kernel_cases import agree_with_twins

test_kernels_agree_with_their_twins = agree_with_twins("turn.cl")
