"""How a command talks: streams that may be lost, tables that fit the terminal, Ctrl-C, notices."""
