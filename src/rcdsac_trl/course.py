"""Drive the office course: ``python -m rcdsac_trl.course run=<folder or shipped agent> beta=[-2,-1]``."""

from rcdsac_trl.cli import Command

main = Command(
    "course",
    "rcdsac_trl.evaluation.course.course_run:make_course",
    describe="rcdsac_trl.report.course_table:write_course",
    look="rcdsac_trl.config.first_look:look_at_course",
)

if __name__ == "__main__":
    main()
