"""The paper's figures, La Camera et al. (2012), Fig. 2 to 7, and pictures of PSFs and costs.

Every function returns a figure and leaves matplotlib's state alone; matplotlib is imported when
the first one is drawn.
"""
