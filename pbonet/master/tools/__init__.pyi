from . import doctor as doctor
from . import foxglove_server as foxglove_server
from . import log_plot as log_plot
from . import playback as playback
from . import schedule_job as schedule_job
from . import write_new_files as write_new_files
