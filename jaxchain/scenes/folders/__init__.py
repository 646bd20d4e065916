"""The folder of a scene's results: what belongs into it, what is there, and who fills it.

- `datasets`: datasets as groups of a Zarr store and of a NetCDF file, whole or not at all
- `groups`: what a scene makes: its groups, and which of them are kept in stores
- `resuming`: a run that was cut off goes on
- `saving`: what tells that a process fills a folder, or that its run was cut off
"""
