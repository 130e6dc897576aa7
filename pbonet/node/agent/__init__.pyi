from . import agent_main as agent_main
from .agent import Agent as Agent
