from . import (
    access_control as access_control,
    client_of_router as client_of_router,
    codec as codec,
    credentials as credentials,
    decoders as decoders,
    dialling as dialling,
    event_codes as event_codes,
    file_messages as file_messages,
    key_expressions as key_expressions,
    messages as messages,
    open_files as open_files,
    pki as pki,
    resource_messages as resource_messages,
    roles as roles,
    rpc as rpc,
    run_folder as run_folder,
    session as session,
    so_linger as so_linger,
    unreachable_reason as unreachable_reason,
)
from .any_message import AnyMessage as AnyMessage
from .callbacks import direct as direct
from .codec import Codec as Codec, failure as failure
from .decoders import convert as convert, decoder as decoder, prepare as prepare
from .deliveries import Deliveries as Deliveries
from .file_messages import FileWrite as FileWrite
from .message_parts import Restart as Restart, VarValue as VarValue
from .messages import (
    LAST_TICKET as LAST_TICKET,
    MOST_CALLERS as MOST_CALLERS,
    MOST_EXTRA as MOST_EXTRA,
    AgentInfo as AgentInfo,
    Answer as Answer,
    AnyRequest as AnyRequest,
    Call as Call,
    Claim as Claim,
    CoreTrace as CoreTrace,
    CoreUse as CoreUse,
    Event as Event,
    Gone as Gone,
    LinkReport as LinkReport,
    ParamValue as ParamValue,
    Reconfig as Reconfig,
    Reconfigured as Reconfigured,
    Record as Record,
    Recorded as Recorded,
    Request as Request,
    RtpuStatus as RtpuStatus,
    SectionStatus as SectionStatus,
    Spawn as Spawn,
    Standing as Standing,
    Stopped as Stopped,
    TaskProfile as TaskProfile,
    TaskStatus as TaskStatus,
    TbufStatus as TbufStatus,
)
from .relay_messages import (
    Letter as Letter,
    read_names as read_names,
    read_result as read_result,
)
from .resource_messages import (
    LONGEST as LONGEST,
    LONGEST_UNANSWERED as LONGEST_UNANSWERED,
    Interrupt as Interrupt,
    XmRequest as XmRequest,
)
from .rpc import Client as Client, Declared as Declared
from .run_folder import NAME as NAME, check_name as check_name, machine as machine
from .session import VALUES_PRIORITY as VALUES_PRIORITY
