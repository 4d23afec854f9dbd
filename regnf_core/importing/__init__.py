"""The importer: uploaded bytes become a regnf field file, or a refusal with a reason. No uploaded byte is
trusted."""
