from ._tape import (
    Outside as Outside,
    Tape as Tape,
    active as active,
    plays as plays,
    use as use,
)
from .answers import NotRecordedError as NotRecordedError
from .playing import (
    BrokenOffError as BrokenOffError,
    Player as Player,
    refuse as refuse,
    using as using,
)
from .told import ModuleAnswers as ModuleAnswers
