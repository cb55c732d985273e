//! One line of the tables in `docs/numerics.md`.

/// What the error of an extreme is measured in and held to.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bar {
    /// What an error of 1 is, such as `pixel`, `of the colour range`, `of the gradient`.
    pub unit: &'static str,
    /// How many times the prediction the error may be.
    pub factor: f64,
    /// What the prediction is made of, and why the factor is enough.
    pub why: &'static str,
}

/// Nothing but equality, or the stated refusal, will do.
pub(crate) const EXACT: Bar = Bar { unit: "", factor: 1.0, why: "as stated, bit for bit" };

/// One stage at one extreme: the worst of its cases, and whether that is good enough.
#[derive(Clone, Debug)]
pub(crate) struct Row {
    /// Stage under test.
    pub stage: &'static str,
    /// What was swept, over which range.
    pub extreme: &'static str,
    /// Number of cases.
    pub cases: usize,
    /// Largest error of all.
    pub largest: f64,
    /// The error that comes nearest to its bound, or is farthest beyond it.
    pub error: f64,
    /// What first-order propagation of rounding or noise predicts for that one.
    pub predicted: f64,
    /// What the error is held to.
    pub bar: Bar,
    /// What happens where the data cannot determine the answer, and anything else that a reader must know.
    pub remark: String,
}

impl Row {
    /// A row without cases, which does not hold.
    pub(crate) fn new(stage: &'static str, extreme: &'static str, bar: Bar) -> Self {
        Self {
            stage,
            extreme,
            cases: 0,
            largest: 0.0,
            error: 0.0,
            predicted: 0.0,
            bar,
            remark: String::new(),
        }
    }

    /// With a remark for the table.
    pub(crate) fn remark(mut self, remark: impl Into<String>) -> Self {
        self.remark = remark.into();
        self
    }

    /// Adds a case. An error that is no number is beyond every bound; a prediction of zero allows no error at all.
    pub(crate) fn case(&mut self, error: f64, predicted: f64) {
        self.case_of([(error, predicted)]);
    }

    /// Adds a case of many values, each with its error and its prediction.
    pub(crate) fn case_of(&mut self, values: impl IntoIterator<Item = (f64, f64)>) {
        self.cases += 1;
        for (error, predicted) in values {
            if !(error <= self.largest) {
                self.largest = error;
            }
            if self.excess(error, predicted) > self.excess(self.error, self.predicted) {
                (self.error, self.predicted) = (error, predicted);
            }
        }
    }

    /// Adds a case that is either as it must be or not.
    pub(crate) fn exact(&mut self, is_right: bool) {
        self.case(if is_right { 0.0 } else { 1.0 }, 0.0);
    }

    /// Adds the cases of another row of the same bar.
    pub(crate) fn absorb(&mut self, other: &Self) {
        self.cases += other.cases;
        if !(other.largest <= self.largest) {
            self.largest = other.largest;
        }
        if other.excess(other.error, other.predicted) > self.excess(self.error, self.predicted) {
            (self.error, self.predicted) = (other.error, other.predicted);
        }
    }

    /// What the kept error is held to.
    pub(crate) fn bound(&self) -> f64 {
        self.bar.factor * self.predicted
    }

    /// Whether there are cases and all of them are within their bounds.
    pub(crate) fn holds(&self) -> bool {
        self.cases > 0 && self.excess(self.error, self.predicted) <= 1.0
    }

    /// Error by bound; 0 where there is no error, infinite where error or bound is no number.
    fn excess(&self, error: f64, predicted: f64) -> f64 {
        let bound = self.bar.factor * predicted;
        if !(error.is_finite() && error >= 0.0 && bound.is_finite() && bound >= 0.0) {
            return f64::INFINITY;
        }
        if error == 0.0 { 0.0 } else { error / bound }
    }
}

/// Whether errors come nearer to their predictions than others do.
pub(crate) fn excess(values: &[(f64, f64)]) -> f64 {
    let ratio = |&(error, predicted): &(f64, f64)| if error == 0.0 { 0.0 } else { error / predicted };
    values.iter().map(ratio).fold(0.0, |worst, ratio| if ratio <= worst { worst } else { ratio })
}

#[cfg(test)]
mod tests {
    use super::*;

    const BAR: Bar = Bar { unit: "pixel", factor: 2.0, why: "rounding" };

    fn row(cases: &[(f64, f64)]) -> Row {
        let mut row = Row::new("stage", "extreme", BAR);
        cases.iter().for_each(|&(error, predicted)| row.case(error, predicted));
        row
    }

    #[test]
    fn the_case_nearest_to_its_bound_is_kept() {
        let row = row(&[(1.0, 10.0), (0.5, 1.0), (3.0, 100.0)]);
        assert_eq!((row.cases, row.error, row.bound(), row.largest), (3, 0.5, 2.0, 3.0));
        assert!(row.holds());
    }

    #[test]
    fn rows_are_absorbed_with_their_worst_case() {
        let mut first = row(&[(1.0, 10.0), (0.5, 1.0)]);
        first.absorb(&row(&[(3.0, 100.0)]));
        assert_eq!((first.cases, first.error, first.largest), (3, 0.5, 3.0));
        first.absorb(&row(&[(2.5, 1.0)]));
        assert!(!first.holds());
        first.absorb(&row(&[(f64::NAN, 1.0)]));
        assert!(first.largest.is_nan() && first.cases == 5);
    }

    #[test]
    fn what_is_beyond_the_bound_does_not_hold() {
        assert!(!row(&[]).holds(), "no case proves nothing");
        assert!(row(&[(2.0, 1.0)]).holds());
        assert!(!row(&[(2.1, 1.0), (0.0, 1.0)]).holds());
        assert!(row(&[(0.0, 0.0)]).holds());
        assert!(!row(&[(1e-300, 0.0)]).holds(), "zero allows nothing");
        for bad in [f64::NAN, f64::INFINITY, -1.0] {
            assert!(!row(&[(bad, 1.0), (0.0, 1.0)]).holds(), "{bad}");
            assert!(!row(&[(0.0, 1.0), (bad, 1.0)]).holds(), "{bad}");
            assert!(!row(&[(1.0, bad)]).holds(), "{bad}");
        }
    }
}
