"""The decision on a refined pose: evidence, verdict, covariance."""
