"""The explorer: a live run in the browser, with sliders, pictures and searches.

- `page`: the page of a visitor: sliders, buttons, numbers and pictures
- `pictures`: the pictures, moved from frame to frame
- `searches`: cycles, branches and boundaries, in a process of their own
- `serving`: the server: `explore`, and `jaxchain explore`
- `session`: a run that goes on while its parameters change
- `takeaway`: the present state as a link, a scene file, a program and a table
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
