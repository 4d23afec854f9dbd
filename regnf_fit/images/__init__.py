"""Fitting a neus-facto field to posed images, with or without depth."""
