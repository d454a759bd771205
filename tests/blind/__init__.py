"""The proof on concealed benches: a generator that shares no code with magjax or fitting, cases, runner, scorer."""
