"""Points in noise: the stars of an image, and whether there is a source beside a model's."""

from lnocl.detection.stars import find_stars

__all__ = ["find_stars"]
