"""Completion of the command line in bash: a script that knows verbs, keys and choices and starts no Python."""

from collections.abc import Iterator

from rcdsac_trl.config.compose import all_keys, offered, root_groups
from rcdsac_trl.config.verbs import VERBS

_SCRIPT = """\
_rcdsac_trl() {{
    local line=${{COMP_LINE:0:COMP_POINT}} words
    local word=${{line##* }}
    if [[ $line != *" "*" "* ]]; then
        words="{verbs}"
    else
        case ${{COMP_WORDS[1]}} in
{cases}
        esac
    fi
    # behind a key, the key alone is nothing to offer
    local without=()
    [[ $word != *= ]] || without=(-X "$word")
    COMPREPLY=($(compgen "${{without[@]}}" -W "$words" -- "$word"))
    # an agent is a name or a folder
    [[ $word != @(run|init)=* ]] || mapfile -t -O ${{#COMPREPLY[@]}} COMPREPLY < <(compgen -d -S / -- "${{word#*=}}")
    # bash takes what stands behind = for a word of its own
    [[ $word != *=* ]] || COMPREPLY=("${{COMPREPLY[@]#"${{word%%=*}}="}}")
    [[ ${{#COMPREPLY[@]}} -ne 1 || ${{COMPREPLY[0]}} == *[=/] ]] || COMPREPLY[0]+=" "
}}
complete -o nospace -o default -F _rcdsac_trl rcdsac-trl
"""


def bash_completion() -> str:
    """Return the script; files are completed behind keys such as ``out=``, agents and folders behind ``run=``."""
    cases = "\n".join(f'            {verb}) words="{" ".join(_words(verb))}" ;;' for verb in VERBS)
    return _SCRIPT.format(verbs=" ".join([*VERBS, "--help", "--version", "--completion"]), cases=cases)


def _words(verb: str) -> Iterator[str]:
    """Yield what may stand behind a verb: options, choices of groups, keys."""
    yield "--help"
    yield "--cfg"
    if verb == "train":
        yield "-m"
    groups = [*(("train",) if verb == "search" else ()), *(("sweep",) if verb == "train" else ()), verb]
    for root in groups:
        for group in root_groups(root):
            plus = "+" if group == "algo" else ""
            yield from (f"{plus}{group}={option}" for option in offered(root, group))
    keys = all_keys(verb)
    sections = {key.rpartition(".")[0] for key in keys}
    yield from (f"{key}=" for key in keys if key not in sections)
    from rcdsac_trl.deploy.policy.registry import shipped_names  # late: only the script needs it

    takes_agents = [key for key in ("run", "init") if key in keys and verb != "plot_training"]
    yield from (f"{key}={name}" for key in takes_agents for name in shipped_names())
