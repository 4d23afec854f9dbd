"""What every key of the service begins with, whichever module it belongs to."""

PREFIX = "regnf:"
