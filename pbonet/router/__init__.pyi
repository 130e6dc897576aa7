from . import router_config as router_config, router_process as router_process
