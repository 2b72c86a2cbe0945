"""Finite CMDPs, solved exactly: the theory, and an oracle for the rest of the library."""
