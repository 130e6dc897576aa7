from .closeable import Closing as Closing
