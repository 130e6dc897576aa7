from . import (
    device_owners as device_owners,
    doctor as doctor,
    draw_graph as draw_graph,
    export_program as export_program,
    express_mail as express_mail,
    foxglove_server as foxglove_server,
    local_modules as local_modules,
    log_plot as log_plot,
    playback as playback,
    remote_files as remote_files,
    scaffold_system as scaffold_system,
    schedule_job as schedule_job,
    write_new_files as write_new_files,
)
from .write_new_files import new_job as new_job
