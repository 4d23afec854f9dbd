"""The preset `robust`: registration without an initial guess, at any scale and in any orientation, with a verdict.

It samples both surfaces, searches all of Sim(3) on those samples alone, refines the few best poses on the fields by
Levenberg-Marquardt, and evaluates them on held-out samples. ``pipeline`` is the whole of it; every tuned number stands
in ``constants``.
"""
