"""The import gate: uploaded bytes become a safe field file, or a refusal with a reason. No uploaded byte is trusted."""
