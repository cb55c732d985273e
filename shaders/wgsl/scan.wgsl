// Exclusive sums of a list, in place: within blocks of 1024 by `reduce`, over the blocks' sums by `spine`, both together by
// `add`; the sort does without `add` and adds the two where it reads them.
// Sums are saturated, so that a list too long for 32 bits is seen as too long.

#import types::{State, group_number}

// What is summed up.
struct ScanSettings {
    // 0: one value per Gaussian and one more; 1 and 2: the histograms of a sort over Gaussians and over intersections.
    list: u32,
}

@group(0) @binding(0) var<uniform> settings: ScanSettings;
@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read_write> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums: array<u32>;

const THREADS: u32 = 256u;
const BLOCK: u32 = 1024u;

var<workgroup> partial: array<u32, THREADS>;

fn length() -> u32 {
    switch settings.list {
        case 0u: { return state.gaussians + 1u; }
        case 1u: { return 256u * ((state.gaussians + BLOCK - 1u) / BLOCK); }
        default: { return 256u * ((state.intersections + BLOCK - 1u) / BLOCK); }
    }
}

fn saturated(a: u32, b: u32) -> u32 {
    return a + min(b, 0xffffffffu - a);
}

// Sum of the values of all threads before this one; `partial[THREADS - 1]` holds the sum of all afterwards.
fn scan_threads(thread: u32, value: u32) -> u32 {
    partial[thread] = value;
    workgroupBarrier();
    for (var stride = 1u; stride < THREADS; stride *= 2u) {
        var before = 0u;
        if thread >= stride {
            before = partial[thread - stride];
        }
        workgroupBarrier();
        partial[thread] = saturated(partial[thread], before);
        workgroupBarrier();
    }
    if thread == 0u {
        return 0u;
    }
    return partial[thread - 1u];
}

@compute @workgroup_size(THREADS)
fn reduce(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = group_number(group, groups);
    let end = length();
    if block * BLOCK >= end {
        return;
    }
    let first = block * BLOCK + 4u * thread;
    var own = vec4(0u);
    for (var i = 0u; i < 4u; i++) {
        if first + i < end {
            own[i] = values[first + i];
        }
    }
    let two = saturated(own.x, own.y);
    let three = saturated(two, own.z);
    let before = scan_threads(thread, saturated(three, own.w));
    let exclusive = vec4(before, saturated(before, own.x), saturated(before, two), saturated(before, three));
    for (var i = 0u; i < 4u; i++) {
        if first + i < end {
            values[first + i] = exclusive[i];
        }
    }
    if thread == THREADS - 1u {
        sums[block] = partial[THREADS - 1u];
    }
}

// One workgroup, however many blocks.
@compute @workgroup_size(THREADS)
fn spine(@builtin(local_invocation_index) thread: u32) {
    let blocks = (length() + BLOCK - 1u) / BLOCK;
    var carry = 0u;
    for (var first = 0u; first < blocks; first += THREADS) {
        let place = first + thread;
        var value = 0u;
        if place < blocks {
            value = sums[place];
        }
        let before = scan_threads(thread, value);
        if place < blocks {
            sums[place] = saturated(carry, before);
        }
        carry = saturated(carry, partial[THREADS - 1u]);
        workgroupBarrier();
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
