"""Questions that take more than one sweep; each is a folder, as `scenes/registry.py` says.

- `_pages`: how their figures look
- `_reports`: what they found, in tables of text
- `_study`: what all of them do: compute, describe, save, report, draw
- `_tables`: tables that several of them share
"""
