// Sums of integers over the threads of a workgroup of 256, in two levels: within parts of the workgroup, then over the parts.
// A part is a subgroup where SUBGROUPS is defined, and sixteen threads that read each other's values where it is not. Integers:
// both give the same bytes.
#define_import_path group_scan

const THREADS: u32 = 256u;

// Where a thread stands in the order of the sums. Whatever depends on that order must go by `number`, not by the local index.
struct Seat {
    // 0 to 255, those of a part in a row.
    number: u32,
    part: u32,
    is_last_of_part: bool,
}

struct Scan {
    // Sum of the values of all threads before this one, and of all threads.
    before: u32,
    total: u32,
}

// Per part the sum of its values. A part might be a single thread.
var<workgroup> totals: array<u32, THREADS>;

fn saturated(a: u32, b: u32) -> u32 {
    return a + min(b, 0xffffffffu - a);
}

#ifdef SUBGROUPS

// Threads that have a number, and in the upper half the parts that they make up.
var<workgroup> numbered: atomic<u32>;

// Nothing says which threads a subgroup has, or how many: each takes as many numbers as it has threads. Which ones it gets
// differs from run to run, what is at each number does not.
fn seat_of(local_index: u32) -> Seat {
    if local_index == 0u {
        atomicStore(&numbered, 0u);
    }
    workgroupBarrier();
    let lane = subgroupExclusiveAdd(1u);
    let size = subgroupAdd(1u);
    var taken = 0u;
    if lane == 0u {
        taken = atomicAdd(&numbered, (1u << 16u) + size);
    }
    taken = subgroupBroadcastFirst(taken);
    return Seat((taken & 0xffffu) + lane, taken >> 16u, lane + 1u == size);
}

fn part_count() -> u32 {
    return atomicLoad(&numbered) >> 16u;
}

// By halves, which cannot overflow.
fn before_in_part(seat: Seat, value: u32) -> u32 {
    let low = subgroupExclusiveAdd(value & 0xffffu);
    let high = subgroupExclusiveAdd(value >> 16u) + (low >> 16u);
    return select((high << 16u) | (low & 0xffffu), 0xffffffffu, high > 0xffffu);
}

#else

const PART: u32 = 16u;

var<workgroup> shared_values: array<u32, THREADS>;

fn seat_of(local_index: u32) -> Seat {
    return Seat(local_index, local_index / PART, local_index % PART == PART - 1u);
}

fn part_count() -> u32 {
    return THREADS / PART;
}

fn before_in_part(seat: Seat, value: u32) -> u32 {
    shared_values[seat.number] = value;
    workgroupBarrier();
    var before = 0u;
    for (var other = seat.part * PART; other < seat.number; other++) {
        before = saturated(before, shared_values[other]);
    }
    return before;
}

#endif

// Saturated sums; in uniform control flow.
fn scan_threads(seat: Seat, value: u32) -> Scan {
    // Nobody reads the totals of a scan before any more, and the threads of a subgroup are together again.
    workgroupBarrier();
    let within = before_in_part(seat, value);
    if seat.is_last_of_part {
        totals[seat.part] = saturated(within, value);
    }
    workgroupBarrier();
    var before = 0u;
    var total = 0u;
    let parts = part_count();
    for (var part = 0u; part < parts; part++) {
        if part == seat.part {
            before = total;
        }
        total = saturated(total, totals[part]);
    }
    return Scan(saturated(before, within), total);
}
