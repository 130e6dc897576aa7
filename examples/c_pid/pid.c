/* Joint-space PID control in C: the law of pbonet/modules/controllers/joint_pid.py, to the last bit. */
#include <math.h>
#include <pbonet.h>

enum { MOST = 64 };     /* joints that the state has room for */

struct pid {
    const int32_t *ndof;
    const double *q_ref, *q, *qd;
    double *tau;
    double kp, limit, ki, kd, speed;
    double integral[MOST];      /* N*m: one limit bounds every term */
    double away[MOST];          /* rad: from Q_REF to the reference by which a cycle goes */
};

static const pbo_port ports[] = {
    PBO_IN_CONST(struct pid, ndof, "NDOF", "1", "none", "degrees of freedom"),
    PBO_IN_VAR(struct pid, q_ref, "Q_REF", "ndof", "rad", "reference position"),
    PBO_IN_VAR(struct pid, q, "Q_MEZ", "ndof", "rad", "measured position"),
    PBO_IN_VAR(struct pid, qd, "Q^_MEZ", "ndof", "rad/s", "measured velocity"),
    PBO_OUT_VAR(struct pid, tau, "T_REF", "ndof", "N*m", "commanded torque, within +-limit"),
};

static const pbo_param params[] = {
    PBO_PARAM(struct pid, kp, "N*m/rad", "stiffness", PBO_GE(0)),
    PBO_PARAM(struct pid, limit, "N*m", "largest torque per joint", PBO_GT(0)),
    PBO_PARAM(struct pid, ki, "N*m/(rad*s)", "integral gain", PBO_DEFAULT(0), PBO_GE(0)),
    PBO_PARAM(struct pid, kd, "N*m*s/rad", "damping", PBO_DEFAULT(0), PBO_GE(0)),
    PBO_PARAM(struct pid, speed, "rad/s", "how fast it begins to go to a Q_REF far away", PBO_DEFAULT(0.5), PBO_GT(0)),
};

static double between(double low, double value, double high)
{
    return value < low ? low : value > high ? high : value;
}

static double within(double value, double limit)
{
    return between(-limit, value, limit);
}

static int init(void *state, pbo_task *task)
{
    const struct pid *self = state;
    if (*self->ndof > MOST)
        return pbo_fail(task, 2, "there is room for %d joints, not for %d", MOST, *self->ndof);
    return PBO_OK;
}

/* Without a predecessor it begins where the arm is, which may have been moved by hand.
   With an integral term the torque begins at what the table holds: a swap without a jump. */
static int on(void *state, pbo_task *task)
{
    struct pid *self = state;
    for (int i = 0; i < *self->ndof; i++) {
        double distance = self->q[i] - self->q_ref[i];
        if (!isfinite(distance))
            distance = 0.0;
        if (!task->handover)
            self->away[i] = distance;
        else if (distance < 0.0)    /* what an aborted cycle left of its way */
            self->away[i] = between(distance, self->away[i], 0.0);
        else
            self->away[i] = between(0.0, self->away[i], distance);
        self->integral[i] = 0.0;
        if (self->ki != 0.0)
            self->integral[i] += self->tau[i] + self->kd * self->qd[i]
                                 - self->kp * (self->q_ref[i] + self->away[i] - self->q[i]);
    }
    return PBO_OK;
}

static int cycle(void *state, pbo_task *task)
{
    struct pid *self = state;
    for (int i = 0; i < *self->ndof; i++) {
        self->away[i] -= within(self->away[i], self->speed * task->dt);
        double error = self->q_ref[i] + self->away[i] - self->q[i];
        double sum = self->integral[i] + self->ki * error * task->dt;
        self->integral[i] = within(sum, self->limit);       /* anti-windup */
        double torque = self->kp * error + self->integral[i] - self->kd * self->qd[i];
        self->tau[i] = within(torque, self->limit);
    }
    return PBO_OK;
}

PBO_MODULE(struct pid, "Hold q at q_ref: tau = kp*e + integral(ki*e) - kd*qd, e = q_ref - q.",
           PBO_PORTS(ports), PBO_PARAMS(params), PBO_CLASS("controller"),
           .init = init, .on = on, .cycle = cycle);
