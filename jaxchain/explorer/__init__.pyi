from .serving import Explorer as Explorer
from .serving import explore as explore
from .session import Session as Session
