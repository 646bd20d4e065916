"""Questions that take more than one sweep; each is a folder, as `scenes/registry.py` says.

- `_pages`: how their figures look
- `_reports`: what they found, in tables of text
- `_study`: what all of them do: compute, describe, save, report, draw
- `_tables`: tables that several of them share
- `basins`: how likely each state is, over belt speed and coupling
- `boundaries`: both boundaries over damping, friction, coupling and width
- `edges`: the motion on the boundary between two basins
- `fronts`: when a vibrating block grows, stands or shrinks, and how fast
- `mistuning`: rings of random stiffness
- `states`: the paper's Figures 4 to 10
"""
