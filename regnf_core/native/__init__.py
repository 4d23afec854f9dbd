"""The evaluator of neus-facto fields in C, and what loads and calls it."""
