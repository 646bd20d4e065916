"""What the commands of `jaxchain` do, beside their options in `cli`.

- `boundary_words`: what `jaxchain boundary` prints
- `scenes`: `jaxchain run`, `resume` and `status`
"""
