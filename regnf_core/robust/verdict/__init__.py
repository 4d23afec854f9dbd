"""The verdict on refined poses: evidence, criteria, evaluation, covariance."""
