from . import agent_main as agent_main
