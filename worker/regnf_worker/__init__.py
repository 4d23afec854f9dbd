"""What runs a job: takes an id, opens regnf field files, calls regnf_core, writes results.

The worker's parent process imports no torch; each job runs in a forked child that does.
"""
