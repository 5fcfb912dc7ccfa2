def interrupted(monkeypatch, owner, name, *numbers):
    """Have a signal come at some calls of a function; return the list of its calls."""
    calls, function = [], getattr(owner, name)

    def counted(*arguments):
        calls.append(arguments)
        if len(calls) in numbers:
            raise KeyboardInterrupt
        return function(*arguments)

    monkeypatch.setattr(owner, name, counted)
    return calls
