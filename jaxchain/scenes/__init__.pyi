from .files import SceneError as SceneError
from .folder import Results as Results
from .running import run_scene as run_scene
from .scene import Scene as Scene
from .scene import load_scene as load_scene
from .scene import schema as schema
