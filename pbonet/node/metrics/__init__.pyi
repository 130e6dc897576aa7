from .metrics_server import (
    MetricsServer as MetricsServer,
    check_address as check_address,
)
