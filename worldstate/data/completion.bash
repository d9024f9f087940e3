_worldstate() {
    local current="${COMP_WORDS[COMP_CWORD]}" called="${COMP_WORDS[1]}" words="" first=2
    case "$called" in
    @groups@) called="$called ${COMP_WORDS[2]}"; first=3 ;;
    esac
    if [ "$COMP_CWORD" -eq 1 ]; then
        words="@commands@ --help --version"
    elif [ "$COMP_CWORD" -lt "$first" ]; then
        case "${COMP_WORDS[1]}" in
@members@
        esac
    else
        case "$called ${COMP_WORDS[COMP_CWORD-1]}" in
@choices@
        *) if [ "${current:0:1}" = "-" ]; then
            case "$called" in
@options@
            esac
        fi ;;
        esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "$current"))
}
complete -o bashdefault -o default -F _worldstate worldstate
