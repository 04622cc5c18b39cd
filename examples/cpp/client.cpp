// A client of `qpavoid serve panda_ball`. apt-get install g++ cppzmq-dev nlohmann-json3-dev
// g++ -std=c++17 -O2 client.cpp -lzmq -o client && ./client tcp://127.0.0.1:5570
#include <algorithm>
#include <cstdio>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <zmq.hpp>
using nlohmann::json;

json ask(zmq::socket_t& socket, json request) {
    request["version"] = 1;
    const auto bytes = json::to_msgpack(request);
    socket.send(zmq::buffer(bytes), zmq::send_flags::none);
    zmq::message_t reply;
    if (!socket.recv(reply)) throw std::runtime_error("no answer: stop the robot");
    const auto* data = static_cast<const char*>(reply.data());
    const json answer = json::from_msgpack(data, data + reply.size());
    if (answer["type"] == "error") throw std::runtime_error(answer["text"].get<std::string>());
    return answer;
}

int main(int count, char** words) {
    zmq::context_t context;
    zmq::socket_t socket(context, ZMQ_REQ);
    socket.set(zmq::sockopt::rcvtimeo, 1000);  // [ms]
    socket.connect(count > 1 ? words[1] : "tcp://127.0.0.1:5570");
    const json hello = ask(socket, {{"type", "hello"}});
    ask(socket, {{"type", "reset"}});
    std::vector<double> q = hello["q0"];
    const double dt = hello["dt"];
    json command;
    for (int k = 0; k < 300; ++k) {
        const json ball = {{"position", {0.6 - 0.1 * k * dt, 0.0, 0.5}}, {"linear", {-0.1, 0.0, 0.0}}};
        const json target = {{"position", {0.31, std::min(0.1 * k * dt, 0.2), 0.49}}};
        command = ask(socket, {{"type", "step"}, {"seq", k}, {"q", q}, {"t", k * dt},
                               {"targets", {{hello["targets"][0].get<std::string>(), target}}}, {"obstacles", {{"ball", ball}}}});
        for (size_t i = 0; i < q.size(); ++i) q[i] += dt * command["v"][i].get<double>();  // your robot goes here
    }
    std::printf("%s: %s\n", hello["robot"].get<std::string>().c_str(), command["status"].get<std::string>().c_str());
}
