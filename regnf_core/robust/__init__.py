"""The preset `robust`: registration without a starting guess, at any scale and in any orientation, with a verdict.

Samples of both surfaces, hypotheses over all of Sim(3) scored on those samples alone, Levenberg-Marquardt on the fields
for the few that can win, and a judgment on samples that the refinement has not seen.
"""
