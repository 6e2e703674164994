"""Drive the office course: ``python -m rcdsac_trl.course run=<folder or shipped agent> beta=[-2,-1]``."""

from omegaconf import DictConfig

from rcdsac_trl.cli import entry_point


def check(cfg: DictConfig) -> None:
    """Refuse what cannot work, before anything is written."""
    from rcdsac_trl.evaluation.course.make_course import make_course

    make_course(cfg)


@entry_point("course", check=check)
def main(cfg: DictConfig) -> None:
    """Drive forward and in reverse, write the runs, then the paper's second table and a picture of them."""
    from rcdsac_trl.evaluation.course.make_course import make_course
    from rcdsac_trl.report.course_table import write_course

    course = make_course(cfg)
    course.run()
    print(write_course(course.results.path))
    print(f"written to {course.results.path}")


if __name__ == "__main__":
    main()
