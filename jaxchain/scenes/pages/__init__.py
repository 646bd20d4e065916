"""`report.html` in a folder of results: one file that opens anywhere, without a network.

- `contents`: everything that the page says, as plain data
- `keys`: what the keys of a scene mean
- `opening`: how its data are opened, in several languages
- `outcomes`: how the runs ended, and what to do about failures
- `page`: `report.html`, behind a run or renewed
- `picture`: the figure as text within a page
- `tables`: what a dataset holds: its variables, its widths, its error bars
"""
