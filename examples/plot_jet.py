"""
A jet beside its star
=====================

Four images of a jet and its star, simulated and deconvolved.
"""

# %%
import lnocl
