"""Single depth images of objects among other things, simulated, and what is found in them."""
