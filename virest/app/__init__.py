"""The program: command line, settings, jobs, and what a run writes."""
