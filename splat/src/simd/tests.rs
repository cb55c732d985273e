use super::*;

simd_kernel! { fn powers(exponents: &[f32; LANES], to: &mut [f32; LANES]) = powers_kernel }

#[inline(always)]
fn powers_kernel<S: Simd>(exponents: &[f32; LANES], to: &mut [f32; LANES]) {
    S::load(exponents).exp2().store(to);
}

#[test]
fn exp2_stays_within_its_bound_over_the_whole_range_on_every_instruction_set() {
    for instructions in Instructions::available() {
        for group in 0..78_750 {
            let exponents: [f32; LANES] =
                std::array::from_fn(|lane| -126.0 + (LANES * group + lane) as f32 * 1e-4);
            let mut found = [0.0; LANES];
            powers(instructions, &exponents, &mut found);
            for (x, found) in exponents.into_iter().zip(found) {
                let relative = (f64::from(found) / f64::from(x).exp2() - 1.0).abs();
                assert!(relative < 2.5e-7, "{} 2^{x}: {relative:e}", instructions.set());
            }
        }
    }
}

/// Runs every operation of an instruction set on the same numbers as [`Plain`].
#[inline(always)]
fn same_as_plain<S: Simd>() {
    let a: [f32; LANES] = std::array::from_fn(|lane| (lane as f32 - 7.3) * 1.7);
    let b: [f32; LANES] = std::array::from_fn(|lane| 3.1 - lane as f32 * 0.37);
    let run = |operation: &str, fast: S, plain: Plain| {
        let (mut x, mut y) = ([0.0; LANES], [0.0; LANES]);
        fast.store(&mut x);
        plain.store(&mut y);
        for lane in 0..LANES {
            // A fused multiply-add rounds once instead of twice; exp2 is a chain of six of them.
            let bound = 1e-5 * y[lane].abs().max(1e-6);
            assert!((x[lane] - y[lane]).abs() <= bound, "{operation} lane {lane}: {} {}", x[lane], y[lane]);
        }
    };
    let (s, t, p, q) = (S::load(&a), S::load(&b), Plain::load(&a), Plain::load(&b));
    run("add", s.add(t), p.add(q));
    run("sub", s.sub(t), p.sub(q));
    run("mul", s.mul(t), p.mul(q));
    run("mul_add", s.mul_add(t, s), p.mul_add(q, p));
    run("max", s.max(t), p.max(q));
    run("min", s.min(t), p.min(q));
    run("exp2", s.exp2(), p.exp2());
    run("ge", S::select(s.ge(t), s, t), Plain::select(p.ge(q), p, q));
    run("lt", S::select(s.lt(t), s, t), Plain::select(p.lt(q), p, q));
    run(
        "both",
        S::select(S::both(s.ge(t), s.lt(S::splat(9.0))), s, t),
        Plain::select(Plain::both(p.ge(q), p.lt(Plain::splat(9.0))), p, q),
    );
    assert_eq!(S::bits(s.ge(t)), Plain::bits(p.ge(q)));
    assert_eq!(S::bits(s.ge(S::splat(12.0))), 0b1000_0000_0000_0000);
    assert_eq!(S::any(s.ge(S::splat(100.0))), Plain::any(p.ge(Plain::splat(100.0))), "none");
    assert_eq!(S::any(s.ge(S::splat(12.0))), Plain::any(p.ge(Plain::splat(12.0))), "one lane");
    run("sqrt", s.mul(s).sqrt(), p.mul(p).sqrt());
    run("floor", s.floor(), p.floor());
    run("ceil", s.ceil(), p.ceil());
    let (mut integers, mut expected) = ([0; LANES], [0; LANES]);
    s.floor().store_integers(&mut integers);
    p.floor().store_integers(&mut expected);
    assert_eq!(integers, expected);
    // The order of the sums is part of the contract: bit for bit.
    let (f, g) = ([s, t, s.add(t), s.mul(t)], [p, q, p.add(q), p.mul(q)]);
    assert_eq!(S::transpose(f).map(lanes), Plain::transpose(g).map(lanes));
    assert_eq!(S::transpose_rows(f).map(lanes), Plain::transpose_rows(g).map(lanes));
    assert_eq!(lanes(S::transpose_rows([s, t, s, t])[2])[..5], [a[2], b[2], a[2], b[2], a[6]]);
    let mut rows = [s; LANES];
    for (row, values) in rows.iter_mut().enumerate() {
        *values = S::splat(100.0 * row as f32).add(s);
    }
    for (column, values) in S::transpose_lanes(rows).into_iter().enumerate() {
        let expected: [f32; LANES] = std::array::from_fn(|row| 100.0 * row as f32 + a[column]);
        assert_eq!(lanes(values), expected, "column {column}");
    }
    assert_eq!(lanes(S::row_sums(f)), lanes(Plain::row_sums(g)));
    run("negated_mul_add", s.negated_mul_add(t, s), p.negated_mul_add(q, p));
    let low = a.first_chunk().expect("half of the lanes");
    let high = b.last_chunk().expect("half of the lanes");
    assert_eq!(lanes(S::load_halves([low, high]))[6..10], [a[6], a[7], b[8], b[9]]);
    let (mut first, mut second) = ([0.0; LANES / 2], [0.0; LANES / 2]);
    s.store_halves([&mut first, &mut second]);
    assert_eq!([first, second].as_flattened(), &a[..]);
    assert_eq!(lanes(s.straddle(t)), lanes(p.straddle(q)));
    assert_eq!(lanes(s.straddle(t))[6..10], [a[14], a[15], b[0], b[1]]);
    let rows = [[1.0, 2.0, 3.0, 4.0], [5.0; 4], [-1.0, 0.5, 0.25, 8.0], [0.0, 1.0, 0.0, 2.0]];
    let (fast, plain) = (S::load_rows(rows.each_ref()), Plain::load_rows(rows.each_ref()));
    assert_eq!(lanes(fast), rows.concat()[..]);
    assert_eq!(lanes(fast.spread_in_rows::<0>()), lanes(plain.spread_in_rows::<0>()));
    assert_eq!(lanes(fast.spread_in_rows::<1>()), lanes(plain.spread_in_rows::<1>()));
    assert_eq!(lanes(fast.spread_in_rows::<2>()), lanes(plain.spread_in_rows::<2>()));
    assert_eq!(lanes(fast.spread_in_rows::<3>())[4..9], [5.0, 5.0, 5.0, 5.0, 8.0]);
    let words: [u32; LANES] = std::array::from_fn(|lane| (lane as u32).wrapping_mul(2_654_435_761) >> 12);
    for mask in (0..20).map(|bit| 1 << bit).chain([0, u32::MAX]) {
        let mut found = [0; LANES];
        let count = S::positions(&words, mask, 100, &mut found);
        let expected = (100..).zip(words).filter(|(_, word)| word & mask != 0).map(|(number, _)| number);
        assert!(found[..count].iter().copied().eq(expected), "mask {mask:x}");
    }
    assert_eq!(lanes(S::transpose([s, t, s, t])[2])[..5], [a[8], a[9], a[10], a[11], b[8]]);
}

fn lanes(values: impl Simd) -> [f32; LANES] {
    let mut lanes = [0.0; LANES];
    values.store(&mut lanes);
    lanes
}

simd_kernel! { fn compare() = same_as_plain }

#[test]
fn every_instruction_set_of_this_machine_agrees_with_plain_arrays() {
    for instructions in Instructions::available() {
        compare(instructions);
    }
}

#[test]
fn instruction_sets_have_names_and_unknown_ones_are_refused() {
    for set in InstructionSet::ALL {
        assert_eq!(set.to_string().parse(), Ok(set));
    }
    assert!("avx".parse::<InstructionSet>().is_err_and(|error| error.contains("baseline")));
    assert_eq!(Instructions::require(Instructions::detect().set()), Ok(Instructions::detect()));
}
