#include "frame.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define MAX_FRAME (1ull << 62) /* frame numbers also travel as signed numbers, with a delay taken off or added */
#define SILENCE 1000000000     /* ns without a usable message after which another count may take over */
#define STALLED 100000000      /* ns without one after which a frame that has begun does not delay what was posted */

enum {
    RECENT = 64,     /* answered frames whose sensors are remembered, to tell a duplicate from a late message */
    MAX_JUMP = 4096, /* frames that a session may skip within the silence; more is another count, as of another session */
    SHORT_JUMP = 64, /* frames that a session may skip and still be the same count after a silence */
    CHANGES = 256,
    SNAPSHOTS = 4,
};

/* What has come of one exposure; its slopes stand in the loop's memory. */
typedef struct {
    uint8_t *filled; /* (all sub-apertures) 1 once there */
    uint32_t missing[SRT_MAX_SENSORS];
    uint32_t in_order[SRT_MAX_SENSORS]; /* the first so many sub-apertures are there */
    uint32_t arrived;                   /* bit w: all of sensor w */
    bool begun;
    int64_t first_ns;    /* when it began */
    int64_t complete_ns; /* when the last sensor became whole */
    srt_mirror mirror;   /* as the message with the first sub-aperture of all says, whatever came first */
    int32_t stamp_sec;   /* of the first message */
    uint32_t stamp_nanosec;
} exposure;

/* A SlopeFrame as read; slopes points into the buffer, anywhere. */
typedef struct {
    int32_t stamp_sec;
    uint32_t stamp_nanosec;
    uint64_t session, frame;
    const uint8_t *fingerprint;
    uint16_t sensor, n_sensors, first, n;
    srt_mirror mirror;
    const uint8_t *slopes;
} slope_frame;

typedef struct {
    srt_gate shared; /* what others see stands first */
    struct {
        const uint8_t *message; /* NULL: none */
        size_t size;
        int64_t ns;
    } unwritten; /* the message offered last, until there is time to put it into the ring */
    uint8_t fingerprint[32];
    uint32_t start[SRT_MAX_SENSORS + 1]; /* first sub-aperture of each sensor, then their total */
    int64_t max_behind;
    bool fresh;
    int64_t newest, jumped_to, decided_ns;
    int64_t closed_ns; /* when the loop was last closed while nothing came */
    exposure exposures[SRT_AHEAD];
    uint32_t used[RECENT];
    uint8_t *command; /* the serialised DmCommand, written again and again */
    size_t command_size, body;
    atomic_int snapshot_wanted;
    /* rings of one writer, the loop's thread, and one reader */
    srt_change changes[CHANGES];
    atomic_uint changes_in, changes_out;
    srt_snapshot snapshots[SNAPSHOTS];
    atomic_uint snapshots_in, snapshots_out;
} gate;

int64_t srt_now(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000ll + now.tv_nsec;
}

int64_t srt_received(int64_t stamp_ns, int64_t looked_ns)
{
    struct timespec system;
    clock_gettime(CLOCK_REALTIME, &system);
    int64_t now = srt_now();
    if (stamp_ns <= 0)
        return now;
    int64_t received = now - (system.tv_sec * 1000000000ll + system.tv_nsec - stamp_ns);
    return received < looked_ns ? looked_ns : received > now ? now : received;
}

/* -- little-endian CDR, which aligns from after the 4 bytes of encapsulation --------------------------------------- */

enum {
    HEADER = 16,         /* encapsulation, stamp, length of frame_id */
    SLOPES_BODY = 80,    /* session .. number of slopes */
    COMMAND_BODY = 76,   /* session .. number of commands */
};

#define FRAME_ID "dm"

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "numbers are copied as they travel");

static size_t body_start(size_t frame_id_bytes)
{
    size_t end = HEADER + frame_id_bytes;
    return end + (12 - end % 8) % 8;
}

/* The next field of a type, at a place that moves on past it. */
#define TAKE(place, field) (memcpy(&(field), place, sizeof(field)), place += sizeof(field))
#define PUT(place, type, value) (memcpy(place, &(type){value}, sizeof(type)), place += sizeof(type))

static bool read_slopes(const uint8_t *buffer, size_t size, slope_frame *out)
{
    if (size < HEADER || buffer[0] != 0 || buffer[1] != 1)
        return false;
    uint32_t name, count;
    const uint8_t *place = buffer + 4;
    TAKE(place, out->stamp_sec);
    TAKE(place, out->stamp_nanosec);
    TAKE(place, name);
    if (name > size || body_start(name) + SLOPES_BODY > size)
        return false;
    place = buffer + body_start(name);
    TAKE(place, out->session);
    TAKE(place, out->frame);
    out->fingerprint = place;
    place += 32;
    TAKE(place, out->sensor);
    TAKE(place, out->n_sensors);
    TAKE(place, out->first);
    TAKE(place, out->n);
    TAKE(place, out->mirror.newest);
    TAKE(place, out->mirror.before);
    TAKE(place, out->mirror.fraction);
    TAKE(place, count);
    out->slopes = place;
    size_t left = size - (size_t)(place - buffer);
    /* some writers pad up to 3 bytes */
    return count == 2u * out->n && left >= 4ull * count && left < 4ull * count + 4;
}

/* -- made once ----------------------------------------------------------------------------------------------------- */

static void clear(const gate *g, exposure *e)
{
    memset(e->filled, 0, g->start[g->shared.loop->n_sensors]);
    memset(e->in_order, 0, sizeof e->in_order);
    memcpy(e->missing, g->shared.loop->n_subapertures, sizeof e->missing);
    e->begun = false;
    e->arrived = 0;
    e->stamp_sec = 0;
    e->stamp_nanosec = 0;
}

srt_gate *srt_gate_new(const uint32_t *n_subapertures, uint32_t n_sensors, uint32_t n_commands, float delay,
                       uint32_t max_epochs, uint32_t tip_tilt_sensors, const uint8_t fingerprint[32],
                       int64_t deadline_ns, int64_t max_behind)
{
    gate *g = calloc(1, sizeof *g);
    if (!g)
        return NULL;
    srt_loop *loop = srt_loop_new(n_subapertures, n_sensors, n_commands, delay, max_epochs, tip_tilt_sensors);
    g->shared.loop = loop;
    if (!loop)
        goto no_memory;
    memcpy(g->fingerprint, fingerprint, sizeof g->fingerprint);
    for (uint32_t w = 0; w < n_sensors; w++)
        g->start[w + 1] = g->start[w] + n_subapertures[w];
    g->max_behind = max_behind;
    g->shared.latency.deadline_ns = g->shared.frame_latency.deadline_ns = deadline_ns;
    g->shared.largest_message = HEADER + 256 + 8 + SLOPES_BODY + 4 * (size_t)loop->n_slopes + 4;
    g->fresh = true;
    g->newest = g->jumped_to = -1;
    for (int i = 0; i < SRT_AHEAD; i++) {
        if (!(g->exposures[i].filled = malloc(g->start[n_sensors] + 1)))
            goto no_memory;
        g->exposures[i].mirror = (srt_mirror){-1, -1, 1.0f};
        clear(g, &g->exposures[i]);
    }
    for (int i = 0; i < SNAPSHOTS; i++)
        if (!(g->snapshots[i].state = malloc(loop->n_rows * sizeof(float))) ||
            !(g->snapshots[i].history = malloc((size_t)SRT_HISTORY * loop->n_rows * sizeof(float))) ||
            !(g->snapshots[i].tip_tilt = malloc(loop->n_rows * sizeof(float))))
            goto no_memory;
    g->body = body_start(sizeof FRAME_ID);
    g->command_size = g->body + COMMAND_BODY + 4 * (size_t)n_commands;
    if (!(g->command = calloc(1, g->command_size)))
        goto no_memory;
    g->command[1] = 1;
    memcpy(g->command + 12, &(uint32_t){sizeof FRAME_ID}, 4);
    memcpy(g->command + HEADER, FRAME_ID, sizeof FRAME_ID);
    return &g->shared;
no_memory:
    srt_gate_free(&g->shared);
    return NULL;
}

void srt_gate_free(srt_gate *shared)
{
    gate *g = (gate *)shared;
    if (!g)
        return;
    for (int i = 0; i < SRT_AHEAD; i++)
        free(g->exposures[i].filled);
    for (int i = 0; i < SNAPSHOTS; i++) {
        free(g->snapshots[i].state);
        free(g->snapshots[i].history);
        free(g->snapshots[i].tip_tilt);
    }
    free(g->command);
    srt_loop_free(g->shared.loop);
    free(g);
}

/* -- what is told -------------------------------------------------------------------------------------------------- */

static void tell(gate *g, int what, int reason, int64_t number)
{
    unsigned in = atomic_load_explicit(&g->changes_in, memory_order_relaxed);
    if (in - atomic_load_explicit(&g->changes_out, memory_order_acquire) == CHANGES) {
        g->shared.counters.changes_lost++;
        return;
    }
    const srt_loop *loop = g->shared.loop;
    g->changes[in % CHANGES] = (srt_change){.session = g->shared.session, .token = loop->token, .frame = loop->frame,
                                            .number = number, .what = what, .reason = reason,
                                            .state = srt_loop_state_of(loop)};
    atomic_store_explicit(&g->changes_in, in + 1, memory_order_release);
}

int srt_gate_next_change(srt_gate *shared, srt_change *out)
{
    gate *g = (gate *)shared;
    unsigned next = atomic_load_explicit(&g->changes_out, memory_order_relaxed);
    if (next == atomic_load_explicit(&g->changes_in, memory_order_acquire))
        return 0;
    *out = g->changes[next % CHANGES];
    atomic_store_explicit(&g->changes_out, next + 1, memory_order_release);
    return 1;
}

void srt_gate_want_snapshot(srt_gate *shared)
{
    atomic_store(&((gate *)shared)->snapshot_wanted, 1);
}

static void snapshot(gate *g, int32_t sec, uint32_t nanosec)
{
    unsigned in = atomic_load_explicit(&g->snapshots_in, memory_order_relaxed);
    if (in - atomic_load_explicit(&g->snapshots_out, memory_order_acquire) == SNAPSHOTS)
        return; /* still wanted, when there is room */
    atomic_store(&g->snapshot_wanted, 0);
    const srt_loop *loop = g->shared.loop;
    srt_snapshot *s = &g->snapshots[in % SNAPSHOTS];
    s->session = g->shared.session;
    s->token = loop->token;
    s->frame = loop->answered;
    s->first_frame = loop->first_frame;
    s->stamp_sec = sec;
    s->stamp_nanosec = nanosec;
    s->consecutive_holds = loop->consecutive_holds;
    s->frames_closed = loop->frames_closed;
    s->loop_state = srt_loop_state_of(loop);
    memcpy(s->state, loop->state, loop->n_rows * sizeof(float));
    memcpy(s->history, loop->history, (size_t)SRT_HISTORY * loop->n_rows * sizeof(float));
    s->tip_tilt_frame = loop->tip_tilt.frame;
    memcpy(s->tip_tilt, loop->tip_tilt.command, loop->n_rows * sizeof(float));
    atomic_store_explicit(&g->snapshots_in, in + 1, memory_order_release);
}

const srt_snapshot *srt_gate_next_snapshot(srt_gate *shared)
{
    gate *g = (gate *)shared;
    unsigned next = atomic_load_explicit(&g->snapshots_out, memory_order_relaxed);
    return next == atomic_load_explicit(&g->snapshots_in, memory_order_acquire) ? NULL
                                                                               : &g->snapshots[next % SNAPSHOTS];
}

void srt_gate_snapshot_done(srt_gate *shared)
{
    atomic_fetch_add_explicit(&((gate *)shared)->snapshots_out, 1, memory_order_release);
}

void srt_latency_add(srt_latency *latency, int64_t ns)
{
    int place = ns > 1000 ? (int)(SRT_BINS_PER_OCTAVE * log2((double)ns / 1000)) : 0;
    latency->counts[place < SRT_BINS ? place : SRT_BINS - 1]++;
    latency->sum += (double)ns;
    latency->squares += (double)ns * (double)ns;
    if (ns > latency->max_ns)
        latency->max_ns = ns;
    if (ns > latency->deadline_ns)
        latency->misses++;
}

/* -- answers ------------------------------------------------------------------------------------------------------- */

static exposure *exposure_of(gate *g, int64_t frame)
{
    return &g->exposures[frame % SRT_AHEAD];
}

/* Whether every sensor that the program wants is here. */
static bool whole(const gate *g, const exposure *e)
{
    uint32_t wanted = g->shared.loop->wanted;
    return (e->arrived & wanted) == wanted;
}

/* reason: why the loop may open now, if it was not asked to */
static void prepare_for(gate *g, int reason, int64_t number)
{
    srt_loop *loop = g->shared.loop;
    uint64_t token = loop->token;
    int state = srt_loop_state_of(loop);
    srt_loop_prepare(loop);
    if (loop->token != token)
        tell(g, SRT_PROGRAM, SRT_ASKED, 0);
    if (srt_loop_state_of(loop) != state)
        tell(g, SRT_LOOP, reason, number);
}

static void prepare(gate *g)
{
    const srt_loop *loop = g->shared.loop;
    bool by_faults = loop->closed && loop->consecutive_holds > loop->program->fault_budget;
    prepare_for(g, by_faults ? SRT_FAULTS : SRT_ASKED, loop->consecutive_holds);
}

/* Form the products of what is here of the next frame, as far as sub-apertures are here in order. */
static void multiply(gate *g, const exposure *e)
{
    srt_loop *loop = g->shared.loop;
    for (uint32_t w = 0; w < loop->n_sensors; w++)
        if (e->in_order[w] > loop->multiplied[w])
            srt_loop_multiply(loop, w, e->in_order[w]);
}

/* Take up what was posted or requested, and form the products of what is here of the next frame anew. */
static void take_up(gate *g)
{
    prepare(g);
    multiply(g, exposure_of(g, g->shared.loop->frame));
}

static size_t write_command(gate *g, const exposure *e, int64_t frame, const srt_program *program, int64_t since_ns)
{
    const srt_loop *loop = g->shared.loop;
    uint8_t *place = g->command + 4;
    PUT(place, int32_t, e->stamp_sec);
    PUT(place, uint32_t, e->stamp_nanosec);
    place = g->command + g->body;
    PUT(place, uint64_t, g->shared.session);
    PUT(place, uint64_t, (uint64_t)frame);
    PUT(place, uint64_t, program ? program->reconstructor : 0);
    PUT(place, uint32_t, program ? program->settings : 0);
    PUT(place, uint32_t, loop->used);
    PUT(place, uint8_t, (uint8_t)loop->verdict);
    PUT(place, uint8_t, (uint8_t)srt_loop_state_of(loop));
    PUT(place, uint16_t, (uint16_t)(loop->n_clipped < 65535 ? loop->n_clipped : 65535));
    PUT(place, float, program ? loop->gain : 0.0f);
    PUT(place, int64_t, loop->tip_tilt.frame);
    PUT(place, int64_t, loop->mirror_frame);
    PUT(place, int64_t, loop->mirror_frame_before);
    PUT(place, float, loop->mirror_fraction);
    uint8_t *latency = place;
    place += sizeof(float);
    PUT(place, uint32_t, loop->n_commands);
    memcpy(place, loop->command, loop->n_commands * sizeof(float));
    PUT(latency, float, (float)((double)(srt_now() - since_ns) * 1e-9));
    return g->command_size;
}

/* The message offered last into the ring; after what others wait for. */
static void write_offered(gate *g)
{
    if (g->unwritten.message)
        srt_ring_write(&g->shared.ring, SRT_SLOPES, g->unwritten.ns, g->unwritten.message, g->unwritten.size);
    g->unwritten.message = NULL;
}

enum { FLATTEN = -1 }; /* in place of a verdict */

static void answer_next(gate *g, int verdict)
{
    srt_loop *loop = g->shared.loop;
    srt_counters *counters = &g->shared.counters;
    int64_t frame = loop->frame;
    exposure *e = exposure_of(g, frame);
    int64_t since_ns = loop->wanted && whole(g, e) ? e->complete_ns : g->decided_ns;
    const srt_program *program = loop->program;
    bool alone = program && program->n_epochs > 1 && !loop->several;
    if (verdict == FLATTEN)
        verdict = srt_loop_flatten(loop);
    else if (verdict == SRT_OK)
        verdict = srt_loop_answer(loop, e->mirror.newest, e->mirror.before, e->mirror.fraction);
    else if (verdict == SRT_HOLD_MISSING && e->begun)
        verdict = srt_loop_hold(loop, SRT_HOLD_INCOMPLETE);
    else
        verdict = srt_loop_hold(loop, verdict);
    size_t size = write_command(g, e, frame, program, since_ns);
    int failure = g->shared.publish ? g->shared.publish(g->shared.publish_context, g->command, size) : 0;
    int64_t out_ns = srt_now();
    write_offered(g);
    if (!failure)
        srt_ring_write(&g->shared.ring, SRT_COMMANDS, out_ns, g->command, size);
    else if (!g->shared.failure)
        g->shared.failure = failure;
    srt_latency_add(&g->shared.latency, out_ns - since_ns);
    if (e->begun)
        srt_latency_add(&g->shared.frame_latency, out_ns - e->first_ns);
    counters->commands++;
    counters->clipped += loop->n_clipped;
    counters->slewed += loop->n_slewed;
    counters->scaled += (uint64_t)loop->scaled;
    switch (verdict) {
    case SRT_OK:
        counters->fallback += alone;
        break;
    case SRT_HOLD_NONFINITE:
        counters->held_nonfinite++;
        break;
    case SRT_HOLD_INCOMPLETE:
        counters->held_incomplete++;
        break;
    case SRT_HOLD_MISSING:
        counters->held_missing++;
        break;
    case SRT_HOLD_BEHIND:
        counters->held_behind++;
        break;
    case SRT_HOLD_HISTORY:
        counters->held_history++;
        break;
    case SRT_HOLD_CLOSED:
        counters->held_closed++;
        break;
    }
    g->used[frame % RECENT] = loop->used;
    int32_t sec = e->stamp_sec;
    uint32_t nanosec = e->stamp_nanosec;
    clear(g, e);
    if (atomic_load_explicit(&g->snapshot_wanted, memory_order_relaxed))
        snapshot(g, sec, nanosec);
    take_up(g);
}

static void skip_next(gate *g)
{
    const srt_loop *loop = g->shared.loop;
    answer_next(g, loop->sensors == loop->wanted ? SRT_HOLD_BEHIND : SRT_HOLD_MISSING);
}

static void advance(gate *g)
{
    const srt_loop *loop = g->shared.loop;
    while (g->newest >= loop->frame) {
        if (g->newest - loop->frame > g->max_behind)
            skip_next(g);
        else if (loop->sensors == loop->wanted)
            answer_next(g, SRT_OK);
        else if (g->newest >= loop->frame + 2 || whole(g, exposure_of(g, loop->frame + 1)))
            answer_next(g, SRT_HOLD_MISSING);
        else
            return;
    }
}

void srt_gate_advance(srt_gate *shared)
{
    advance((gate *)shared);
    write_offered((gate *)shared);
}

/* -- messages ------------------------------------------------------------------------------------------------------ */

/* Whole sensors, or a packet of one, and a number that a frame can have. */
static bool fits(const gate *g, const slope_frame *s)
{
    uint32_t first = s->sensor, n = s->n_sensors, n_sensors = g->shared.loop->n_sensors;
    if (n < 1 || first + n > n_sensors || s->session == 0 || s->frame >= MAX_FRAME)
        return false;
    uint32_t valid = g->start[first + n] - g->start[first];
    if (n == 1)
        return s->n > 0 && (uint32_t)s->first + s->n <= valid;
    return s->first == 0 && s->n == valid;
}

static void begin(gate *g, uint64_t session, int64_t frame)
{
    srt_loop *loop = g->shared.loop;
    for (int i = 0; i < SRT_AHEAD; i++)
        clear(g, &g->exposures[i]);
    memset(g->used, 0, sizeof g->used);
    g->jumped_to = -1;
    int reason = session == g->shared.session ? SRT_GOES_ON : SRT_NEW_SESSION;
    int64_t due = loop->frame;
    /* a loop that was closed before any slopes came stays closed; a session after another starts with an open one */
    if (g->fresh)
        prepare(g);
    int state = g->fresh ? srt_loop_state_of(loop) : SRT_RELAXES;
    g->fresh = false;
    g->shared.session = session;
    g->newest = frame;
    srt_loop_start(loop, frame, state);
    tell(g, SRT_SESSION, reason, due);
    prepare(g);
}

/* Whether a frame follows on the newest, or on an earlier exposure that jumped to just before it. */
static bool follows(gate *g, int64_t frame)
{
    int64_t newest = g->newest > g->shared.loop->frame ? g->newest : g->shared.loop->frame;
    if (frame <= newest + SRT_AHEAD)
        return true;
    bool agreed = 0 < frame - g->jumped_to && frame - g->jumped_to <= SRT_AHEAD;
    g->jumped_to = agreed ? -1 : frame;
    return agreed;
}

/* Put a message in its place; false, and nothing done, if any of it was here before. */
static bool put(gate *g, exposure *e, const slope_frame *s, int64_t now_ns)
{
    srt_loop *loop = g->shared.loop;
    uint32_t start = g->start[s->sensor] + s->first;
    if (memchr(e->filled + start, 1, s->n))
        return false;
    memset(e->filled + start, 1, s->n);
    if (!e->begun) {
        e->begun = true;
        e->first_ns = now_ns;
        e->stamp_sec = s->stamp_sec;
        e->stamp_nanosec = s->stamp_nanosec;
    }
    if (start == 0)
        e->mirror = s->mirror;
    const uint8_t *slopes = s->slopes;
    for (uint32_t w = s->sensor; w < (uint32_t)s->sensor + s->n_sensors; w++) {
        uint32_t valid = loop->n_subapertures[w], n = s->n_sensors == 1 ? s->n : valid;
        srt_interleave(slopes, n, srt_loop_slopes(loop, (int64_t)s->frame, w) + 2 * s->first);
        slopes += 8 * (size_t)n;
        e->missing[w] -= n;
        if (!e->missing[w])
            e->arrived |= 1u << w;
        if (e->in_order[w] == s->first) {
            const uint8_t *filled = e->filled + g->start[w];
            const uint8_t *gap = memchr(filled + s->first, 0, valid - s->first);
            e->in_order[w] = gap ? (uint32_t)(gap - filled) : valid;
        }
    }
    return true;
}

static void place(gate *g, const slope_frame *s, int64_t now_ns)
{
    int64_t frame = (int64_t)s->frame;
    exposure *e = exposure_of(g, frame);
    uint32_t before = e->arrived;
    if (!put(g, e, s, now_ns)) {
        g->shared.counters.dropped_duplicate++;
        return;
    }
    if (frame > g->newest)
        g->newest = frame;
    if (e->arrived != before)
        e->complete_ns = now_ns;
    if (frame == g->shared.loop->frame)
        multiply(g, e);
}

/* A message of stars that count their own frames. */
static void offer_stars(gate *g, const slope_frame *s, int64_t now_ns)
{
    srt_counters *counters = &g->shared.counters;
    uint32_t sensors = (uint32_t)(((1ull << s->n_sensors) - 1) << s->sensor);
    bool whole = s->first == 0 && s->n == g->start[s->sensor + s->n_sensors] - g->start[s->sensor];
    if (!whole || sensors & g->shared.loop->all_sensors) {
        counters->dropped_malformed++;
        return;
    }
    if (g->fresh || s->session != g->shared.session) {
        counters->dropped_session++;
        return;
    }
    switch (srt_tip_tilt_put(g->shared.loop, (int64_t)s->frame, s->sensor, s->n_sensors, s->slopes)) {
    case SRT_PUT:
        g->shared.last_tip_tilt_ns = now_ns;
        break;
    case SRT_DUPLICATE:
        counters->dropped_duplicate++;
        break;
    case SRT_LATE:
        counters->dropped_late++;
        break;
    case SRT_STRAY:
        counters->dropped_session++;
        break;
    }
}

int64_t srt_gate_offer(srt_gate *shared, const uint8_t *message, size_t size, int64_t now_ns)
{
    gate *g = (gate *)shared;
    srt_counters *counters = &shared->counters;
    const srt_loop *loop = shared->loop;
    write_offered(g); /* the one before */
    g->unwritten.message = message;
    g->unwritten.size = size;
    g->unwritten.ns = now_ns;
    slope_frame s;
    if (!read_slopes(message, size, &s)) {
        counters->dropped_malformed++;
        return -1;
    }
    if (memcmp(s.fingerprint, g->fingerprint, sizeof g->fingerprint)) {
        counters->dropped_fingerprint++;
        return -1;
    }
    if (!fits(g, &s)) {
        counters->dropped_malformed++;
        return -1;
    }
    if ((((1ull << s.n_sensors) - 1) << s.sensor) & loop->tip_tilt.sensors) {
        offer_stars(g, &s, now_ns);
        return -1;
    }
    int64_t frame = (int64_t)s.frame, ahead = frame - loop->frame;
    bool same = s.session == shared->session;
    uint32_t held = (uint32_t)(((1ull << s.n_sensors) - 1) << s.sensor);
    if (same && ahead < 0 && !(held & loop->wanted))
        return frame; /* nobody waits for a closed sensor: it may come when it likes */
    if (same && ahead < 0) {
        bool recent = -ahead <= RECENT && frame >= loop->first_frame;
        if (recent && g->used[frame % RECENT] >> s.sensor & 1)
            counters->dropped_duplicate++;
        else
            counters->dropped_late++;
        return frame;
    }
    bool silent = now_ns - shared->last_slopes_ns >= SILENCE;
    if (g->fresh || (silent && !(same && ahead <= SHORT_JUMP))) {
        begin(g, s.session, frame);
    } else if (!same || ahead > MAX_JUMP || !follows(g, frame)) {
        counters->dropped_session++;
        return frame;
    }
    shared->last_slopes_ns = g->decided_ns = now_ns;
    while (frame >= loop->frame + SRT_AHEAD)
        skip_next(g);
    place(g, &s, now_ns);
    return frame;
}

void srt_gate_start(srt_gate *shared)
{
    gate *g = (gate *)shared;
    g->fresh = true;
    g->unwritten.message = NULL;
    take_up(g);
}

static void flatten(gate *g, int state, int reason, int64_t number)
{
    g->decided_ns = srt_now();
    srt_loop_request(g->shared.loop, state);
    prepare_for(g, reason, number);
    answer_next(g, FLATTEN);
}

void srt_gate_idle(srt_gate *shared, int64_t now_ns)
{
    gate *g = (gate *)shared;
    srt_loop *loop = shared->loop;
    int64_t silence = now_ns - shared->last_slopes_ns;
    bool untouched = !exposure_of(g, loop->frame)->begun;
    if (srt_loop_pending(loop) && (untouched || silence > STALLED)) {
        bool closed = loop->closed;
        take_up(g);
        if (loop->closed && !closed)
            g->closed_ns = now_ns; /* the sensors have from now on the watchdog's time to come back */
    }
    if (g->fresh || silence <= STALLED)
        return;
    int64_t watchdog = loop->program ? loop->program->watchdog_ns : 0;
    if (loop->closed && watchdog && silence > watchdog && now_ns - g->closed_ns > watchdog) {
        loop->opened_by_silence++;
        flatten(g, SRT_RELAXES, SRT_SILENCE, silence);
    } else if (loop->held_flat && srt_gate_not_flat(shared)) {
        flatten(g, SRT_FLAT, SRT_ASKED, 0); /* no frame will do it */
    }
}

int srt_gate_not_flat(const srt_gate *shared)
{
    const srt_loop *loop = shared->loop;
    bool shown = loop->closed;
    for (uint32_t i = 0; i < loop->n_commands; i++)
        shown = shown || loop->state[i] != 0 || loop->tip_tilt.command[i] != 0;
    return shared->session && shown;
}

void srt_gate_flatten(srt_gate *shared)
{
    flatten((gate *)shared, SRT_RELAXES, SRT_ASKED, 0);
}

size_t srt_abi(void)
{
    return sizeof(srt_product) + sizeof(srt_block) + sizeof(srt_zone) + sizeof(srt_low_rank) + sizeof(srt_matrices) + sizeof(srt_program) + offsetof(srt_loop, posted) +
           sizeof(srt_change) + sizeof(srt_snapshot) + sizeof(srt_gate);
}
