"""What the commands of `jaxchain` do, beside their options in `cli`.

- `basin_words`: what `jaxchain basins` prints
- `boundary_words`: what `jaxchain boundary` prints
- `scenes`: `jaxchain run`, `resume` and `status`
"""
