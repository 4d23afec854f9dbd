"""Batches at the front end: lines become pairs, pairs become jobs a few at a time, and their ends become results."""
