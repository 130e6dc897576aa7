from .answers import answer as answer, answer_of as answer_of
from .ask_facts import Extent as Extent, ask as ask, unreached as unreached
from .cause_chain import (
    Cause as Cause,
    Explanation as Explanation,
    Source as Source,
)
from .explanations import explain as explain
from .facts import Facts as Facts, Gap as Gap
from .key_and_link_verdicts import (
    Finding as Finding,
    Level as Level,
    keys_of as keys_of,
    keys_term as keys_term,
    link_verdict as link_verdict,
)
from .known_causes import (
    FLAG_CAUSES as FLAG_CAUSES,
    OWN_TEXT as OWN_TEXT,
    REMEDIES as REMEDIES,
)
from .log_facts import read_log as read_log
from .question import Question as Question, asked_by as asked_by
