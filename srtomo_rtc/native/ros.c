/* The loop's thread: waits for slopes at rcl, and publishes commands there. Built against rcl's headers; its library is
 * the only one that needs ROS. */
#include <rcl/error_handling.h>
#include <rcl/rcl.h>

#include "frame.h"

/* How srt_run runs; mirrored in srtomo_rtc/native.py. */
typedef struct {
    rcl_context_t *context;
    rcl_subscription_t *slopes;
    rcl_publisher_t *commands;
    rcl_guard_condition_t *wake;
    int64_t poll_ns; /* how long to look for slopes again and again before blocking; 0: block at once */
    /* for measurements: (frame, when the middleware received it, ns of the system's clock) of each message that fits */
    int64_t *received;
    size_t received_room, received_count;
} srt_ros;

static const int64_t TIMEOUT = 100000000; /* ns between looks at what was posted when nothing comes */

typedef struct {
    rcl_publisher_t *publisher;
    rcl_serialized_message_t message;
} outlet;

static int publish(void *context, const uint8_t *message, size_t size)
{
    outlet *out = context;
    out->message.buffer = (uint8_t *)message;
    out->message.buffer_length = out->message.buffer_capacity = size;
    return rcl_publish_serialized_message(out->publisher, &out->message, NULL);
}

static rcl_ret_t block(rcl_wait_set_t *waiting, const srt_ros *ros)
{
    rcl_ret_t result = rcl_wait_set_clear(waiting);
    if (result == RCL_RET_OK)
        result = rcl_wait_set_add_subscription(waiting, ros->slopes, NULL);
    if (result == RCL_RET_OK)
        result = rcl_wait_set_add_guard_condition(waiting, ros->wake, NULL);
    if (result == RCL_RET_OK)
        result = rcl_wait(waiting, TIMEOUT);
    return result == RCL_RET_TIMEOUT ? RCL_RET_OK : result;
}

/* In turns: the gate still looks at the message before. */
typedef struct {
    rcl_serialized_message_t messages[2];
    int next;
} inlet;

/* Offer all that has come; whether anything had. looked: when there was nothing last, and then when there is nothing.
 * One message's time is later than another's that was taken before it: the recorder keeps them in that order. */
static rcl_ret_t take_all(srt_gate *gate, srt_ros *ros, inlet *in, int64_t *looked, bool *came)
{
    rmw_message_info_t info;
    rcl_ret_t result;
    *came = false;
    int64_t look = srt_now();
    rcl_serialized_message_t *message;
    while ((result = rcl_take_serialized_message(ros->slopes, message = &in->messages[in->next], &info, NULL)) ==
           RCL_RET_OK) {
        in->next = !in->next;
        *came = true;
        *looked = srt_received(info.received_timestamp, *looked) + 1;
        int64_t frame = srt_gate_offer(gate, message->buffer, message->buffer_length, *looked);
        if (frame >= 0 && ros->received_count < ros->received_room) {
            ros->received[2 * ros->received_count] = frame;
            ros->received[2 * ros->received_count++ + 1] = info.received_timestamp;
        }
        look = srt_now();
    }
    *looked = look > *looked ? look : *looked;
    return result == RCL_RET_SUBSCRIPTION_TAKE_FAILED ? RCL_RET_OK : result;
}

static rcl_ret_t run(srt_gate *gate, srt_ros *ros, rcl_wait_set_t *waiting, inlet *in)
{
    srt_gate_start(gate);
    int64_t last = srt_now(), looked = last;
    while (!atomic_load_explicit(&gate->stop, memory_order_acquire)) {
        bool came;
        rcl_ret_t result = take_all(gate, ros, in, &looked, &came);
        if (result != RCL_RET_OK)
            return result;
        srt_gate_advance(gate);
        int64_t now = srt_now();
        srt_gate_idle(gate, now);
        if (gate->failure)
            return gate->failure;
        if (came)
            last = now;
        else if (now - last >= ros->poll_ns && (result = block(waiting, ros)) != RCL_RET_OK)
            return result;
    }
    return RCL_RET_OK;
}

/* Wait, take and answer until gate->stop is set and ros->wake triggered; then publish flat. rcl's result; not 0: failed,
 * and rcl's error string of this thread says why. */
int srt_run(srt_gate *gate, srt_ros *ros)
{
    rcl_allocator_t allocator = rcl_get_default_allocator();
    rcl_wait_set_t waiting = rcl_get_zero_initialized_wait_set();
    rcl_ret_t result = rcl_wait_set_init(&waiting, 1, 1, 0, 0, 0, 0, ros->context, allocator);
    if (result != RCL_RET_OK)
        return result;
    /* room for every message that fits: the middleware then has nothing to allocate for it */
    inlet in = {{rmw_get_zero_initialized_serialized_message(), rmw_get_zero_initialized_serialized_message()}, 0};
    for (int i = 0; i < 2 && result == RCL_RET_OK; i++)
        result = rmw_serialized_message_init(&in.messages[i], gate->largest_message, &allocator);
    if (result == RCL_RET_OK) {
        outlet out = {.publisher = ros->commands};
        out.message.allocator = allocator;
        srt_publish before = gate->publish;
        void *context = gate->publish_context;
        gate->publish = publish;
        gate->publish_context = &out;
        result = run(gate, ros, &waiting, &in);
        if (result == RCL_RET_OK && srt_gate_not_flat(gate)) {
            srt_gate_flatten(gate);
            result = gate->failure;
        }
        gate->publish = before;
        gate->publish_context = context;
        gate->failure = 0;
    }
    for (int i = 0; i < 2; i++)
        if (in.messages[i].buffer && rmw_serialized_message_fini(&in.messages[i]) != RMW_RET_OK &&
            result == RCL_RET_OK)
            result = RCL_RET_ERROR;
    if (rcl_wait_set_fini(&waiting) != RCL_RET_OK && result == RCL_RET_OK)
        result = RCL_RET_ERROR;
    return result;
}

/* Why srt_run failed; on its thread, and once. */
void srt_ros_error(char *text, size_t size)
{
    rcl_error_string_t error = rcl_get_error_string();
    size_t i = 0;
    for (; i + 1 < size && error.str[i]; i++)
        text[i] = error.str[i];
    text[i] = 0;
    rcl_reset_error();
}

size_t srt_ros_abi(void)
{
    return sizeof(srt_ros);
}
