"""Equations of any kind: roots, their derivatives, branches of solutions."""
