"""Channel models: is the message of slot k lost?

One module a model, with a function `model` of its parameters, of the slot's uniform random numbers and, where the
channel has a memory, of its state before the slot; it also gives the state after it. `registry` names them all: those
found in this folder, `trace`, whose outcomes were measured and are in a file, those that ask where the AGV is
(`position_dependent`), `shared`, in which the messages of a fleet compete, and those of other packages.
"""
