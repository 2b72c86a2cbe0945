"""One module per figure or table of the paper, and per result beyond it.

Each has

    TITLE                     its heading in the report
    run(sources, folder)      numbers to be saved as results.json; `sources("jam")` is the folder of
                              a finished run of `commands.COMMANDS`, made when first asked for
    plot(results, folder)     figures, from the numbers alone; not where a table says it all
    tell(results)             `section.Section`: words, tables, verdicts

and is listed in `experiments.all`.
"""
