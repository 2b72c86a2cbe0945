"""Runs: reconnaissance, planning and evaluation as jobs that tell, are kept, and go on."""
