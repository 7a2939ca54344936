/* An aeration basin as an FMU for co-simulation, FMI 2.0 and 3.0 in one library; it needs no headers but libc's.

   dc/dt = kla(b) (9 - c) - u c / (c + 0.4),   kla(b) = 16 b / (b + 60) [1/h],   db/dt = (air - b) / 40 s,
   dp/dt = (c - p) / 60 s

   c [mg/l] is the dissolved oxygen, b [%] the blower, p [mg/l] the probe, u [mg/(l h)] the uptake of the sludge. */

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))
enum { OK, WARNING, DISCARD, ERROR };
enum { AIR, UPTAKE, OXYGEN, COUNT };
static const double INNER = 5.0; /* s, the longest step of the integration */

typedef void (*Log2)(void *, const char *, int, const char *, const char *, ...);
typedef void (*Log3)(void *, int, const char *, const char *);
typedef struct { Log2 logger; void *allocate, *release, *finished, *environment; } Callbacks2;
typedef struct { double air, uptake, oxygen, blower, probe, time; } Basin;
typedef struct { Basin now; Log2 log2; Log3 log3; void *environment; } Instance;

static double kla(double blower) { return 16.0 * blower / (blower + 60.0); }

static void begin(Basin *b) { /* at rest: the oxygen at which supply and uptake are equal, by bisection */
    double low = 0.0, high = 9.0;
    memset(b, 0, sizeof *b);
    b->air = b->blower = 40.0;
    b->uptake = 32.0;
    for (int k = 0; k < 60; k++) {
        double c = 0.5 * (low + high);
        if (kla(b->blower) * (9.0 - c) > b->uptake * c / (c + 0.4)) low = c; else high = c;
    }
    b->oxygen = b->probe = low;
}

static Instance *made(Log2 log2, Log3 log3, void *environment) {
    Instance *i = calloc(1, sizeof *i);
    if (i) { i->log2 = log2; i->log3 = log3; i->environment = environment; begin(&i->now); }
    return i;
}

static int advance(Instance *i, double step) {
    Basin *b = &i->now;
    if (b->air < 0.0) {
        const char *words = "the air is below zero";
        if (i->log2) i->log2(i->environment, "aeration", ERROR, "logStatusError", "%s", words);
        if (i->log3) i->log3(i->environment, ERROR, "logStatusError", words);
        return ERROR;
    }
    int n = (int)(step / INNER + 0.999999);
    double h = step / n;
    for (int k = 0; k < n; k++) {
        double c = b->oxygen;
        b->oxygen += h / 3600.0 * (kla(b->blower) * (9.0 - c) - b->uptake * c / (c + 0.4));
        b->blower += h / 40.0 * (b->air - b->blower);
        b->probe += h / 60.0 * (c - b->probe);
    }
    b->time += step;
    return OK;
}

static int get(Instance *i, const unsigned *names, size_t n, double *values) {
    for (size_t k = 0; k < n; k++) {
        if (names[k] >= COUNT) return ERROR;
        values[k] = names[k] == AIR ? i->now.air : names[k] == UPTAKE ? i->now.uptake : i->now.probe;
    }
    return OK;
}

static int set(Instance *i, const unsigned *names, size_t n, const double *values) {
    for (size_t k = 0; k < n; k++) {
        if (names[k] == AIR) i->now.air = values[k];
        else if (names[k] == UPTAKE) i->now.uptake = values[k];
        else return ERROR;
    }
    return OK;
}

static int keep(Instance *i, void **state) {
    if (!*state) *state = malloc(sizeof(Basin));
    if (!*state) return ERROR;
    memcpy(*state, &i->now, sizeof(Basin));
    return OK;
}

static int restore(Instance *i, const void *state) { memcpy(&i->now, state, sizeof(Basin)); return OK; }
static int forget(void **state) { free(*state); *state = NULL; return OK; }

static int unpack(const void *bytes, size_t n, void **state) {
    if (n != sizeof(Basin)) return ERROR;
    if (!*state) *state = malloc(sizeof(Basin));
    if (!*state) return ERROR;
    memcpy(*state, bytes, n);
    return OK;
}

/* A function that the standard wants to be there, and that this FMU does not offer. */
#define NONE(name) EXPORT int name(void) { return ERROR; }

/* ---------------------------------------------------------------- FMI 2.0 */
EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT int fmi2SetDebugLogging(Instance *i, int on, size_t n, const char *const *c) { return OK; }
EXPORT void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources, const Callbacks2 *c,
                             int visible, int logging) { return type == 1 ? made(c->logger, NULL, c->environment) : NULL; }
EXPORT void fmi2FreeInstance(Instance *i) { free(i); }
EXPORT int fmi2SetupExperiment(Instance *i, int t, double tolerance, double start, int s, double stop) { return OK; }
EXPORT int fmi2EnterInitializationMode(Instance *i) { return OK; }
EXPORT int fmi2ExitInitializationMode(Instance *i) { return OK; }
EXPORT int fmi2Terminate(Instance *i) { return OK; }
EXPORT int fmi2Reset(Instance *i) { begin(&i->now); return OK; }
EXPORT int fmi2GetReal(Instance *i, const unsigned *r, size_t n, double *v) { return get(i, r, n, v); }
EXPORT int fmi2SetReal(Instance *i, const unsigned *r, size_t n, const double *v) { return set(i, r, n, v); }
EXPORT int fmi2GetInteger(Instance *i, const unsigned *r, size_t n, int *v) { return n ? ERROR : OK; }
EXPORT int fmi2GetBoolean(Instance *i, const unsigned *r, size_t n, int *v) { return n ? ERROR : OK; }
EXPORT int fmi2GetString(Instance *i, const unsigned *r, size_t n, const char **v) { return n ? ERROR : OK; }
EXPORT int fmi2SetInteger(Instance *i, const unsigned *r, size_t n, const int *v) { return n ? ERROR : OK; }
EXPORT int fmi2SetBoolean(Instance *i, const unsigned *r, size_t n, const int *v) { return n ? ERROR : OK; }
EXPORT int fmi2SetString(Instance *i, const unsigned *r, size_t n, const char *const *v) { return n ? ERROR : OK; }
EXPORT int fmi2GetFMUstate(Instance *i, void **s) { return keep(i, s); }
EXPORT int fmi2SetFMUstate(Instance *i, void *s) { return restore(i, s); }
EXPORT int fmi2FreeFMUstate(Instance *i, void **s) { return forget(s); }
EXPORT int fmi2SerializedFMUstateSize(Instance *i, void *s, size_t *n) { *n = sizeof(Basin); return OK; }
EXPORT int fmi2SerializeFMUstate(Instance *i, void *s, char *to, size_t n) { memcpy(to, s, n); return OK; }
EXPORT int fmi2DeSerializeFMUstate(Instance *i, const char *from, size_t n, void **s) { return unpack(from, n, s); }
EXPORT int fmi2DoStep(Instance *i, double now, double step, int no) { return advance(i, step); }
EXPORT int fmi2CancelStep(Instance *i) { return ERROR; }

NONE(fmi2GetDirectionalDerivative) NONE(fmi2SetRealInputDerivatives) NONE(fmi2GetRealOutputDerivatives)
NONE(fmi2GetStatus) NONE(fmi2GetRealStatus) NONE(fmi2GetIntegerStatus) NONE(fmi2GetBooleanStatus)
NONE(fmi2GetStringStatus)

/* ---------------------------------------------------------------- FMI 3.0 */
EXPORT const char *fmi3GetVersion(void) { return "3.0"; }
EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible,
                                         bool logging, bool events, bool early, const unsigned *r, size_t n,
                                         void *environment, Log3 log, void *update) {
    return made(NULL, log, environment);
}
EXPORT void fmi3FreeInstance(Instance *i) { free(i); }
EXPORT int fmi3EnterInitializationMode(Instance *i, bool t, double tolerance, double start, bool s, double stop) {
    return OK;
}
EXPORT int fmi3ExitInitializationMode(Instance *i) { return OK; }
EXPORT int fmi3Terminate(Instance *i) { return OK; }
EXPORT int fmi3Reset(Instance *i) { begin(&i->now); return OK; }
EXPORT int fmi3GetFloat64(Instance *i, const unsigned *r, size_t n, double *v, size_t m) { return get(i, r, n, v); }
EXPORT int fmi3SetFloat64(Instance *i, const unsigned *r, size_t n, const double *v, size_t m) {
    return set(i, r, n, v);
}
EXPORT int fmi3GetFMUState(Instance *i, void **s) { return keep(i, s); }
EXPORT int fmi3SetFMUState(Instance *i, void *s) { return restore(i, s); }
EXPORT int fmi3FreeFMUState(Instance *i, void **s) { return forget(s); }
EXPORT int fmi3SerializedFMUStateSize(Instance *i, void *s, size_t *n) { *n = sizeof(Basin); return OK; }
EXPORT int fmi3SerializeFMUState(Instance *i, void *s, uint8_t *to, size_t n) { memcpy(to, s, n); return OK; }
EXPORT int fmi3DeserializeFMUState(Instance *i, const uint8_t *from, size_t n, void **s) { return unpack(from, n, s); }
EXPORT int fmi3DoStep(Instance *i, double now, double step, bool no, bool *event, bool *end, bool *early, double *last) {
    *event = *end = *early = false;
    *last = now + step;
    return advance(i, step);
}
NONE(fmi3SetDebugLogging) NONE(fmi3InstantiateModelExchange) NONE(fmi3InstantiateScheduledExecution)
NONE(fmi3EnterEventMode) NONE(fmi3GetFloat32) NONE(fmi3GetInt8) NONE(fmi3GetUInt8) NONE(fmi3GetInt16)
NONE(fmi3GetUInt16) NONE(fmi3GetInt32) NONE(fmi3GetUInt32) NONE(fmi3GetInt64) NONE(fmi3GetUInt64) NONE(fmi3GetBoolean)
NONE(fmi3GetString) NONE(fmi3GetBinary) NONE(fmi3GetClock) NONE(fmi3SetFloat32) NONE(fmi3SetInt8) NONE(fmi3SetUInt8)
NONE(fmi3SetInt16) NONE(fmi3SetUInt16) NONE(fmi3SetInt32) NONE(fmi3SetUInt32) NONE(fmi3SetInt64) NONE(fmi3SetUInt64)
NONE(fmi3SetBoolean) NONE(fmi3SetString) NONE(fmi3SetBinary) NONE(fmi3SetClock)
NONE(fmi3GetNumberOfVariableDependencies) NONE(fmi3GetVariableDependencies) NONE(fmi3GetDirectionalDerivative)
NONE(fmi3GetAdjointDerivative) NONE(fmi3EnterConfigurationMode) NONE(fmi3ExitConfigurationMode)
NONE(fmi3GetIntervalDecimal) NONE(fmi3GetIntervalFraction) NONE(fmi3GetShiftDecimal) NONE(fmi3GetShiftFraction)
NONE(fmi3SetIntervalDecimal) NONE(fmi3SetIntervalFraction) NONE(fmi3SetShiftDecimal) NONE(fmi3SetShiftFraction)
NONE(fmi3EvaluateDiscreteStates) NONE(fmi3UpdateDiscreteStates) NONE(fmi3EnterContinuousTimeMode)
NONE(fmi3CompletedIntegratorStep) NONE(fmi3SetTime) NONE(fmi3SetContinuousStates)
NONE(fmi3GetContinuousStateDerivatives) NONE(fmi3GetEventIndicators) NONE(fmi3GetContinuousStates)
NONE(fmi3GetNominalsOfContinuousStates) NONE(fmi3GetNumberOfEventIndicators) NONE(fmi3GetNumberOfContinuousStates)
NONE(fmi3EnterStepMode) NONE(fmi3GetOutputDerivatives) NONE(fmi3ActivateModelPartition)
