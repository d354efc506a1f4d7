"""The detector's hot loops: live tiles, maxima of the scale space, centroids with covariance, profiles of blobs."""
