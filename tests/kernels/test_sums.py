"""The sums that end an iteration against their twin."""

from kernel_cases import agree_with_twins

test_kernels_agree_with_their_twins = agree_with_twins("sums.cl")
