"""A transmission of the sky against its twins."""

from kernel_cases import agree_with_twins

test_kernels_agree_with_their_twins = agree_with_twins("transmit.cl")
