"""Whether a commit made the engine slower: two commits side by side in one run, in processor time."""
