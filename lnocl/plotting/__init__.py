"""Pictures of results, stars, PSFs, profiles and costs.

Every function returns a figure and leaves matplotlib's state alone; matplotlib is imported when
the first one is drawn.
"""
