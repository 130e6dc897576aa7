from ._cmodule import (
    ABI as ABI,
    NativeMethod as NativeMethod,
    NativeState as NativeState,
    SharedObject as SharedObject,
)
from .include import get_include as get_include
from .module_class import c_class as c_class
