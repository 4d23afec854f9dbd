"""The contract's nouns: what comes in is checked by these models, what goes out is documented by them."""
