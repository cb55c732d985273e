// Exclusive sums of a list, in place: within blocks of 1024 by `reduce`, over the blocks' sums by `spine`, both together by
// `add`; the sort does without `add` and adds the two where it reads them.
// Sums are saturated, so that a list too long for 32 bits is seen as too long.

#import types::{State, group_number}
#import group_scan::{THREADS, seat_of, saturated, scan_threads}

// What is summed up.
struct ScanSettings {
    // 0: one value per Gaussian and one more; 1 and 2: the histograms of a sort over Gaussians and over intersections.
    list: u32,
}

@group(0) @binding(0) var<uniform> settings: ScanSettings;
@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read_write> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums: array<u32>;

const BLOCK: u32 = 1024u;

fn length() -> u32 {
    switch settings.list {
        case 0u: { return state.gaussians + 1u; }
        case 1u: { return 256u * ((state.gaussians + BLOCK - 1u) / BLOCK); }
        default: { return 256u * ((state.intersections + BLOCK - 1u) / BLOCK); }
    }
}

@compute @workgroup_size(THREADS)
fn reduce(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local_index: u32,
) {
    let block = group_number(group, groups);
    let end = length();
    if block * BLOCK >= end {
        return;
    }
    let seat = seat_of(local_index);
    let first = block * BLOCK + 4u * seat.number;
    var own = vec4(0u);
    for (var i = 0u; i < 4u; i++) {
        if first + i < end {
            own[i] = values[first + i];
        }
    }
    let two = saturated(own.x, own.y);
    let three = saturated(two, own.z);
    let scan = scan_threads(seat, saturated(three, own.w));
    let before = scan.before;
    let exclusive = vec4(before, saturated(before, own.x), saturated(before, two), saturated(before, three));
    for (var i = 0u; i < 4u; i++) {
        if first + i < end {
            values[first + i] = exclusive[i];
        }
    }
    if seat.number == 0u {
        sums[block] = scan.total;
    }
}

// One workgroup, however many blocks.
@compute @workgroup_size(THREADS)
fn spine(@builtin(local_invocation_index) local_index: u32) {
    let blocks = (length() + BLOCK - 1u) / BLOCK;
    let seat = seat_of(local_index);
    var carry = 0u;
    for (var first = 0u; first < blocks; first += THREADS) {
        let block = first + seat.number;
        var value = 0u;
        if block < blocks {
            value = sums[block];
        }
        let scan = scan_threads(seat, value);
        if block < blocks {
            sums[block] = saturated(carry, scan.before);
        }
        carry = saturated(carry, scan.total);
    }
}

@compute @workgroup_size(THREADS)
fn add(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = group_number(group, groups);
    let end = length();
    if block * BLOCK >= end {
        return;
    }
    let before = sums[block];
    for (var i = 0u; i < 4u; i++) {
        let place = block * BLOCK + i * THREADS + thread;
        if place < end {
            values[place] = saturated(values[place], before);
        }
    }
}
