"""A fuzzer for the gate's stages: it knows archives, pickles and safetensors headers, and is repeatable by its seed."""
