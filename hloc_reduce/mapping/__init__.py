"""Maps of photos alone: COLMAP's mapper, which of its images are plausible, what is missing."""
