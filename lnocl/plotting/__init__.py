"""Pictures of results, stars, PSFs and profiles.

Every function returns a figure and leaves matplotlib's state alone; matplotlib is imported when
the first one is drawn.
"""
