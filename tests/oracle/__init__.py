"""Independent slow references, written from the paper in scalar NumPy; they import neither magjax nor fitting."""
