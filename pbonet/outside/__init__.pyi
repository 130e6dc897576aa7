from . import open_devices as open_devices
from ._tape import (
    Outside as Outside,
    Tape as Tape,
    active as active,
    plays as plays,
    use as use,
)
from .answers import NotRecordedError as NotRecordedError
from .files import (
    ReadFile as ReadFile,
    files_read as files_read,
    note_file as note_file,
    sha256_of as sha256_of,
)
from .module_answers import ModuleAnswers as ModuleAnswers
from .playing import (
    BrokenOffError as BrokenOffError,
    Player as Player,
    refuse as refuse,
    using as using,
)
